"""From batches of messages to the objects that the spool stores."""
