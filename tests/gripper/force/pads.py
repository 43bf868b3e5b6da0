"""Pads that report another force than there is."""


class WrongPads:
    """Pads that report another force from a moment on.

    Parameters
    ----------
    cell
        Its sensor is replaced.
    report
        Returns the sample that the pads give in place of the right one.
    """

    def __init__(self, cell, report) -> None:
        self.began_s: float | None = None
        self._latest_force = cell.sensor.latest_force
        self._report = report
        cell.sensor.latest_force = self.latest_force

    def latest_force(self):
        sample = self._latest_force()
        if sample is None or self.began_s is None:
            return sample
        return self._report(sample)
