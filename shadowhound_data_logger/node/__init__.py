"""Everything in the node's process, from subscriptions to closed batches. Messages are passed on unchanged.

One thread, the intake, takes every message serialized, five times per second. It writes, sends and deserializes nothing. QoS
follows the publishers. When the queue to the encoders is full, messages of the lowest priority are dropped and counted.
"""
