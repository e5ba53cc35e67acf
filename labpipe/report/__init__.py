"""What a report says: sections, tables and figures as data, not yet drawn."""
