"""The conditions of contacts and ties: found, checked, with friction, and on deformed surfaces."""
