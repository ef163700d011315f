"""Where objects are kept: S3, a folder, or memory; one Protocol (``base.py``), one conformance suite."""
