"""Encodes batches of messages into objects for the spool, with the encoders of ``formats/``."""
