"""Opening a sensor on the CANopen control unit: bus, link and sensor in one call."""

from collections.abc import Callable
from contextlib import ExitStack

from tactile.can.bus import CanBus, close_bus, open_bus
from tactile.control_unit.node import TactileLink
from tactile.control_unit.settings import LinkSettings
from tactile.layout import TaxelLayout, paper_layout
from tactile.sensor.calibration import Calibration, FoamCalibration
from tactile.sensor.sensor import TactileSensor
from tactile.sensor.settings import SensorSettings


def open_sensor(
    channel: str | CanBus,
    layout: TaxelLayout | None = None,
    calibration: Calibration | None = None,
    *,
    interface: str = "socketcan",
    bitrate: int = 1_000_000,
    node_id: int = 5,
    link: LinkSettings | None = None,
    settings: SensorSettings | None = None,
    reopen: Callable[[], CanBus] | None = None,
) -> TactileSensor:
    """Open the control unit's CAN bus and return its sensor; ``with`` starts the unit.

    Leaving the block stops the frames and closes the bus. SYNC goes out, and faults show, while the
    sensor is read; 20,000 unread messages are a fault of the link.

    Parameters
    ----------
    channel
        Channel of the CAN interface, as can0 or /dev/ttyACM0; or an open bus, which stays open: a
        simulated one has the time of its devices with it, as ``clock``.
    layout
        The taxels; by default the paper's: 408 on ten pads.
    calibration
        From counts to newtons; by default the paper's foam.
    interface
        python-can's name of the interface: socketcan, slcan, pcan, ...
    bitrate
        Of the CAN bus, in bit/s.
    node_id
        CANopen node-ID of the unit, 1 to 127.
    link, settings
        Periods and limits of the link, and of the way from frames to forces.
    reopen
        Opens a lost bus anew at the next start; without it a lost bus stays lost.

    Raises
    ------
    BusNotOpened
        When the bus cannot be opened.
    CalibrationError
        When the calibration is for another full scale than the layout's.
    """
    layout = layout or paper_layout()
    calibration = calibration or FoamCalibration(layout.adc_max)
    with ExitStack() as line:
        bus = channel
        if isinstance(bus, str):
            bus = open_bus(interface, bus, bitrate=bitrate)
            line.callback(close_bus, bus)
        source = TactileLink(
            bus,
            node_id=node_id,
            layout=layout,
            settings=link,
            force_law=calibration.force_n,
            reopen=reopen,
        )
        sensor = TactileSensor(source, calibration, clock=source.clock, settings=settings)
        sensor.line = line.pop_all()
    return sensor
