"""The servers of a Tower as processes of this machine, and the access control of its MLflow."""
