"""Tables, figures and model comparison from finished runs."""
