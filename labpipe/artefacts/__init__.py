"""labpipe's own files: a header of kind, schema and provenance over the numbers; written whole or not at all."""
