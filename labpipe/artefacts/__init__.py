"""labpipe's own files: a header of kind, schema and provenance, then the numbers; written completely or not at all."""
