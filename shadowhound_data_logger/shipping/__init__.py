"""Delivery of what is spooled: what goes next, what a failure means, when it is tried again.

How fast bytes may leave (``upload.max_mbps``) is kept by ``bandwidth.py``, how long a pause lasts by ``retry.py``.
"""
