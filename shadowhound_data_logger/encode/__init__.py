"""Batches of raw messages become objects: one registry from format name to encoder."""
