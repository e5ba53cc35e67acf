"""What a package can add to labpipe: a reader, an estimator, a bearing, a virtual rig, a run-up method, a
section.
"""
