"""Pads that sit otherwise: the order of the taxels, and a whole sensor on a cell that has them."""

import numpy as np
import pytest

from simulator.can.messages import read_zero
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from simulator.world.taxels import NoiseModel
from tactile.control_unit.mounting import Mounting
from tactile.control_unit.settings import LinkSettings
from tactile.errors import LayoutError
from tactile.frames.force_message import encode_zero
from tactile.layout import PadMount, paper_layout, pinch_layout, taxel_order
from tactile.sensor.opening import open_sensor
from tactile.source import Arrivals, ForceMessage, ForceStatus

PINCH = pinch_layout()
EXCHANGED = (PadMount(pad=0, sent_as=1), PadMount(pad=1, sent_as=0))
TURNED = tuple(
    PadMount(pad=pad, sent_as=pad, rows_mirrored=True, columns_mirrored=True) for pad in (0, 1)
)


def test_the_order_of_the_taxels_is_that_of_the_mounts() -> None:
    assert (taxel_order(PINCH, ()) == np.arange(156)).all()
    assert (taxel_order(PINCH, EXCHANGED) == np.roll(np.arange(156), 78)).all()
    rows = taxel_order(PINCH, (PadMount(pad=0, sent_as=0, rows_mirrored=True),))
    assert rows[:6].tolist() == [72, 73, 74, 75, 76, 77]
    columns = taxel_order(PINCH, (PadMount(pad=1, sent_as=1, columns_mirrored=True),))
    assert columns[78:84].tolist() == [83, 82, 81, 80, 79, 78]
    assert taxel_order(PINCH, TURNED)[:78].tolist() == list(range(77, -1, -1))


@pytest.mark.parametrize(
    ("mounts", "complaint"),
    [
        ((PadMount(pad=0, sent_as=1),), "name each pad once"),
        ((PadMount(pad=7, sent_as=7),) * 2, "name each pad once"),
        (
            (PadMount(pad=0, sent_as=2), PadMount(pad=2, sent_as=0)),
            "16 x 4 taxels, but is sent as finger0.side_a with 16 x 2: correct sent_as",
        ),
    ],
)
def test_mounts_that_cannot_be_are_refused(mounts, complaint) -> None:
    with pytest.raises(LayoutError, match=complaint):
        taxel_order(paper_layout(), mounts)


def test_forces_and_zero_of_exchanged_and_turned_pads_go_both_ways() -> None:
    message = ForceMessage(
        t_s=1.0, counter=3, status=ForceStatus.ZEROED, force_n=(1.0, 2.0), centre_taxels=(1.5, -0.5)
    )
    exchanged, turned = Mounting(PINCH, EXCHANGED), Mounting(PINCH, TURNED)
    arrived = Arrivals(forces=(message,))
    assert exchanged.arrivals(arrived).forces[0].force_n == (2.0, 1.0)
    assert exchanged.arrivals(arrived).forces[0].centre_taxels == (1.5, -0.5)
    assert turned.arrivals(arrived).forces[0].centre_taxels == (-1.5, 0.5)
    zeros = np.arange(156.0)
    bad = zeros == 5
    for mounting in (exchanged, turned):
        sent = mounting.zero(encode_zero(9.0, zeros, bad, PINCH.adc_max))
        _, found, found_bad = read_zero(sent, 156, PINCH.adc_max)
        order = taxel_order(PINCH, EXCHANGED if mounting is exchanged else TURNED)
        assert found[order][~bad] == pytest.approx(zeros[~bad], abs=0.1)
        assert found_bad[order].tolist() == bad.tolist()


def test_the_unit_cannot_sum_pads_that_are_turned_against_each_other() -> None:
    assert Mounting(PINCH, ()).unit_can_sum
    assert Mounting(PINCH, TURNED).unit_can_sum
    assert not Mounting(PINCH, TURNED[:1]).unit_can_sum
    outer = (PadMount(pad=0, sent_as=1), PadMount(pad=1, sent_as=0))
    assert not Mounting(paper_layout(), outer).unit_can_sum


@pytest.mark.parametrize("mounts", [EXCHANGED, TURNED, TURNED[:1]])
def test_a_sensor_measures_where_the_finger_is_on_pads_that_sit_otherwise(mounts) -> None:
    settings = SimulatorSettings(layout=PINCH, mounts=mounts, noise=NoiseModel(level=0.2))
    with SimulatedCell(settings) as cell:
        link = LinkSettings(mounts=mounts)
        with open_sensor(cell.can_bus, PINCH, link=link) as sensor:
            sensor.tare(20)
            cell.devices.physical.press(0, 12e-3, -5e-3, 2.0)
            for _ in range(20):
                reading = sensor.read()
            assert reading.finger_force_n == pytest.approx((2.0, 0.0), rel=0.1)
            force_n = reading.force_n[:78]
            x_m, y_m = (force_n @ PINCH.taxel_xy_m[:78] / force_n.sum()).tolist()
            assert (x_m, y_m) == pytest.approx((12e-3, -5e-3), abs=1e-3)
            if Mounting(PINCH, mounts).unit_can_sum:
                assert sensor.take_forces()[-1].force_n == pytest.approx((2.0, 0.0), abs=0.3)
            else:
                assert not sensor.has_forces
