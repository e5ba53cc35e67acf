"""labpipe's own files: a header of kind, schema and provenance, then the numbers.

Written completely or not at all.
"""
