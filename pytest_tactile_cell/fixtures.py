"""The fixtures. Heavy modules are imported inside them, when a test requests one."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import pytest

from pytest_tactile_cell.faults import FaultHandle, FaultRegistry, FaultTarget
from pytest_tactile_cell.options import HardwareOptions, config_path, refuse_shadows

if TYPE_CHECKING:
    from cell.config.model import CellConfig
    from gripper.clock import Clock
    from gripper.dynamixel.bus import ServoBus
    from gripper.dynamixel.serial_port import ByteStream
    from pytest_tactile_cell.bench import LinkBench
    from pytest_tactile_cell.process import CellProcess
    from pytest_tactile_cell.virtual import CellRuntime, VirtualCell
    from tactile.can.bus import CanBus


class MadeCell(FaultTarget, Protocol):
    """A simulated cell of a test."""

    def end(self) -> None:
        """End it."""


Made = TypeVar("Made", bound=MadeCell)


@dataclass(frozen=True, slots=True)
class MakeCell(Generic[Made]):
    """Makes cells on simulated devices; the end of the test ends them."""

    config: "CellConfig"
    """Config of the test run."""
    faults: FaultRegistry
    make: Callable[..., Made]
    """Makes a cell of a config and further options."""

    def __call__(
        self,
        config: "CellConfig | Path | str | None" = None,
        *,
        objects: Mapping[str, str] | None = None,
        seed: int | None = None,
        changes: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> Made:
        """Return a new cell.

        Parameters
        ----------
        config
            Config or its file; by default `cell_config`. Simulated ports replace its ports.
        objects
            Shapes by label: ``{"pin": "cylinder:diameter=6mm,length=20mm"}``.
        seed
            Seed of noise and poses.
        changes
            Other values of the config by dotted path: ``{"tactile.tare_frames": 25}``.
        options
            Further arguments; the fixture has their names.

        Raises
        ------
        cell.errors.CellError
            If the resulting config is not valid, or the cell cannot be made.
        """
        from pytest_tactile_cell.configs import simulated_config

        base = self.config if config is None else config
        made = self.make(
            simulated_config(base, objects=objects, seed=seed, changes=changes), **options
        )
        self.faults.add(made, made.end)
        return made


@pytest.fixture
def cell_config(request: pytest.FixtureRequest) -> "CellConfig":
    """Config of the cell under test: from ``--cell-config`` or the ini option ``cell_config``.

    Without either: the built-in simulated cell. A project can override this fixture in its
    conftest.py.
    """
    try:
        refuse_shadows()
    except ImportError as error:
        raise pytest.fail.Exception(str(error), pytrace=False) from None
    from cell.config.file import load_config
    from cell.errors import ConfigError

    try:
        return load_config(config_path(request.config))
    except ConfigError as error:
        raise pytest.fail.Exception(str(error), pytrace=False) from None


@pytest.fixture
def cell_faults() -> Iterator[FaultRegistry]:
    """Keep the simulated cells of this test and the faults in them; tests use inject_fault."""
    with FaultRegistry() as registry:
        yield registry


@pytest.fixture
def cell_bench(
    request: pytest.FixtureRequest, cell_config: "CellConfig", cell_faults: FaultRegistry
) -> "LinkBench":
    """Both links of a cell without a controller, opened on demand.

    Source of servo_bus, servo_stream and can_bus; ``cell_bench.simulated`` has the simulated
    devices.
    """
    from pytest_tactile_cell.bench import LinkBench

    return LinkBench(cell_config, HardwareOptions.of(request.config), cell_faults)


@pytest.fixture
def simulated_cell(
    cell_config: "CellConfig", cell_faults: FaultRegistry
) -> "MakeCell[VirtualCell]":
    """Make simulated cells in virtual time: ``cell = simulated_cell(objects=..., seed=...)``.

    Each has a CellController, the simulated devices and their clock. Time passes only during
    waits, so a grasp takes a fraction of a second. Hardware is never used: simulated ports replace
    those of the config. Settings: config, objects, seed, changes; mover, which gets each pose, and
    places, which brings kept parts, as those of a host program; folder of the recording::

        def test_grip(simulated_cell):
            cell = simulated_cell(objects={"pin": "cylinder:diameter=6mm,length=20mm"})
            record = cell.start("pin").grasp(force_n=3.0)
            assert record.outcome.final_force_n == pytest.approx(3.0, abs=0.5)
    """
    from pytest_tactile_cell.virtual import VirtualCell

    return MakeCell(cell_config, cell_faults, VirtualCell.of)


@pytest.fixture
def cell_runtime(cell_config: "CellConfig", cell_faults: FaultRegistry) -> "MakeCell[CellRuntime]":
    """Load the plugin of a host program on simulated devices: ``cell = cell_runtime(mover=move)``.

    This is the plugin of docs/reference/plugin.md, in virtual time on a thread of its own: start,
    feedback, result, release. grip_n() is the true force. Hardware is never used. Settings: config,
    objects, seed, changes, and the arguments of TactileCellPlugin: mover, places, model, save,
    folder. The end of the test closes it.
    """
    from pytest_tactile_cell.virtual import CellRuntime

    return MakeCell(cell_config, cell_faults, CellRuntime)


@pytest.fixture
def servo_bus(cell_bench: "LinkBench") -> "ServoBus":
    """ServoBus on the simulated servos in virtual time, or on real ones with ``--servo-port``.

    Opening and closing write nothing to the servos. ``servo_clock`` is its clock,
    ``cell_config.gripper.servos`` has the IDs.
    """
    return cell_bench.servo_bus


@pytest.fixture
def servo_stream(cell_bench: "LinkBench") -> "ByteStream":
    """Bytes of the same line as servo_bus, for tests below the level of packets."""
    return cell_bench.servo_line[0]


@pytest.fixture
def servo_clock(cell_bench: "LinkBench") -> "Clock":
    """Clock of servo_bus: virtual, or the module time with ``--servo-port``."""
    return cell_bench.servo_line[1]


@pytest.fixture
def can_bus(cell_bench: "LinkBench") -> "CanBus":
    """python-can bus with the simulated control unit, or a real one with ``--can-interface``.

    Waiting in ``recv`` advances the virtual time. ``can_clock`` is its clock,
    ``cell_config.tactile.node_id`` the unit's node.
    """
    return cell_bench.can_line[0]


@pytest.fixture
def can_clock(cell_bench: "LinkBench") -> "Clock":
    """Clock of can_bus: virtual, or the module time with ``--can-interface``."""
    return cell_bench.can_line[1]


@pytest.fixture
def cell_process(
    request: pytest.FixtureRequest, cell_config: "CellConfig", cell_faults: FaultRegistry
) -> "MakeCell[CellProcess]":
    """Start ``tactile-cell simulate`` in real time: ``cell = cell_process(objects=..., seed=...)``.

    Servos and CAN adapter are on pseudo-terminals. The result has servo_port, can_channel,
    config_path (a config for any program), positioner_socket, ask(), wait_for_grip(), kill().
    The end of the test ends the process. A process that ended by itself fails the test with its
    log.
    """
    from pytest_tactile_cell.process import CellProcess

    return MakeCell(
        cell_config, cell_faults, partial(CellProcess, report=request.node.add_report_section)
    )


@pytest.fixture
def inject_fault(cell_faults: FaultRegistry) -> Callable[..., FaultHandle]:
    """Inject faults into the simulated cell of the test: ``inject_fault("can.loss=0.05@2s")``.

    For cells of simulated_cell and cell_process and for the devices of servo_bus and can_bus; on
    hardware faults are refused. Returns the fault with clear(); the end of the test clears all
    faults. ``tactile-cell simulate --list-faults`` lists the vocabulary.
    """
    return cell_faults.inject
