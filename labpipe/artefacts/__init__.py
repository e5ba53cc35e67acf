"""labpipe's file formats: a header of kind, schema and provenance, then the numbers; written completely or not at all."""
