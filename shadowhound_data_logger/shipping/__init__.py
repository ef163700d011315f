"""Delivery of what is spooled: what is sent next, what a failure means, when it is tried again.

One process delivers at a time. Transient failures are retried indefinitely, terminal ones quarantine the object, wrong
credentials pause everything. Each delivered object has exactly one catalog row (``catalog_writer.py``).

How fast bytes may leave (``upload.max_mbps``) is kept by ``bandwidth.py``, how long a pause lasts by ``retry.py``.
"""
