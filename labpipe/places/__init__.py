"""Files that lie elsewhere: in the buckets of an object storage."""
