"""Keeping what was measured: backups and their restoring, checking files against their hashes, room on the disk."""
