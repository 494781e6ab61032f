"""Arrays, torn systems and checkpoints in files."""
