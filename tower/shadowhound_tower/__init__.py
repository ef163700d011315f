"""The servers of a Tower as processes of this machine, and who may do what on its MLflow."""
