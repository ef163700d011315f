"""Bags, events and missions, recorded while the node runs."""
