"""Everything in the node's process, from subscriptions to closed batches. Messages are passed on unchanged."""
