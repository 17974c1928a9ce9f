"""Natural frequencies, mode shapes and static load tests as data."""
