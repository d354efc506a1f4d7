"""What lumidock raises on purpose: one line of text each, fit to be shown to a person."""


class LumidockError(Exception):
    """Base class of every error lumidock raises on purpose."""


class InputError(LumidockError):
    """A file, folder or option that cannot be used at all."""


class FrameError(LumidockError):
    """One frame that cannot be used; `reason` is the fixed word for the `reason` column."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason
