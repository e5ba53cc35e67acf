"""What labpipe can identify or plan: each method whole in its folder, added to the core by entry points."""
