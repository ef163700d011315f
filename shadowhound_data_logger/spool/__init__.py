"""Disk before network: the durable spool, its index and the ledger.

What ``commit`` returned survives a power cut. Object and account are in one transaction, so a ``kill -9`` cannot make them
disagree. ``spool/ready/`` has the tree of the bucket.
"""
