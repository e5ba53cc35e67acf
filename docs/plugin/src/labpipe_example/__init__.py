"""What a package can add to labpipe: a reader, an estimator, a bearing model."""
