"""What a solution is at contacts and ties, measured and transferred to other meshes."""
