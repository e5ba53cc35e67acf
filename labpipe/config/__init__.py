"""YAML -> frozen parameters; every fault at file:line:column, all of a file in one pass."""
