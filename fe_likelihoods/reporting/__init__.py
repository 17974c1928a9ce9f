"""One page about a finished run: what was updated with which data, what was found, and whether to trust it."""
