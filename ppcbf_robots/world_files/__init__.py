"""Worlds from the files that users have, and our own format written back."""
