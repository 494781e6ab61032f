"""The solution at contacts and ties, measured and transferred to other meshes."""
