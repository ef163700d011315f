"""Delivery of what is spooled: schedule, retry, upload."""
