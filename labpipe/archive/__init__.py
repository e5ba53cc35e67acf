"""One file that holds a result with all it was made from: an RO-Crate in a ZIP, for those who must keep or pass on evidence."""
