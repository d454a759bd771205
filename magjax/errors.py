"""Errors that tell the mend: one line each, with the exit status that the command line returns."""


class MagjaxError(Exception):
    """Base of every error a user can cause; `exit_status` is what the command line returns."""

    exit_status = 2


class ConfigurationError(MagjaxError):
    """Wrong use or a wrong bench file (exit status 2)."""

    exit_status = 2


class RecordingError(MagjaxError):
    """A recording that cannot be used as it is (exit status 3).

    `shown`: where it shows, for a picture, if that is known: channel, unit, values, first sample, samples, and time; of a plateau that
    keeps its noise `rests`, its (side, level).
    """

    exit_status = 3

    def __init__(self, text: str = "", shown: dict | None = None):
        super().__init__(text)
        self.shown = shown


class DeviceError(MagjaxError):
    """A port or device that does not answer as it should (exit status 5)."""

    exit_status = 5
