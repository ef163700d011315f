"""What all other folders build on: value types, settings, keys, clocks, errors, retries. It imports none of them."""
