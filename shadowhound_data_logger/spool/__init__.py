"""Disk before network: the durable spool, its index and the ledger."""
