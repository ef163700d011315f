"""From the middleware to the consumers: subscriptions, the takes, the sampling of each topic."""
