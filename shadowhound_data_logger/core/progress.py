"""Reports the progress of a transfer."""


class ProgressListener:
    """Receives the progress of a transfer; any thread calls it. This one ignores it."""

    def begin(self, total: int) -> None:
        """The transfer has this many bytes."""

    def have(self, count: int) -> None:
        """This many more bytes are present, downloaded or already there; negative for those that turned out to be wrong."""
