"""A folder of results as a whole: an index of every identification.json below it, and questions to it."""
