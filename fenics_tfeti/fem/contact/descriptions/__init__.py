"""Contacts and ties as users describe them, checked where they are written."""
