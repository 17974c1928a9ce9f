"""Prior distributions of parameters: of one, of several together, and of all."""
