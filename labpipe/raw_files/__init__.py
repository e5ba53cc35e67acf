"""Raw files and what they hold: readers and writers of other programs' formats, screening of samples, test
signals.
"""
