"""The dual problem: its operator F, preconditioners, PCPG on a face, the active set method."""
