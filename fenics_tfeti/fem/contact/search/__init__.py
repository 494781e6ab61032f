"""The search for contacts that nobody has tagged, for conditions, and for the better slave."""
