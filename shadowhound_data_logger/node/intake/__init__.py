"""From the middleware to the consumers: subscriptions, takes, and sampling."""
