"""What the data tell of the parameters, and which sensors would tell most."""
