"""Encodes batches of messages into objects for the spool."""
