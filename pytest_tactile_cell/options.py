"""Options of the plugin: config and real ports."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest

CONTRACTS = ("sensor", "servo_model", "recognizer")
"""Kinds of plugins that have a contract: files of `pytest_tactile_cell.contracts`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HardwareOptions:
    """Options of the command line for real hardware; None: not given."""

    servo_port: str | None = None
    """Port of the servos; None: simulated servos."""
    can_interface: str | None = None
    can_channel: str | None = None
    """CAN adapter, for python-can; None: a simulated control unit."""
    allow_motion: bool = False
    """Whether tests may switch torque on and move real servos."""

    @classmethod
    def of(cls, config: pytest.Config) -> "HardwareOptions":
        """Return the options of a test run."""
        return cls(**{name: config.getoption(name) for name in cls.__dataclass_fields__})


def config_path(config: pytest.Config) -> Path | None:
    """Return the config of the cell under test: ``--cell-config``, else the ini option, else None.

    The ini option is relative to its file.
    """
    given: str | None = config.getoption("cell_config")
    if given is not None:
        return Path(given)
    ini: str = config.getini("cell_config")
    if not ini:
        return None
    return (config.inipath or config.rootpath / "-").parent / ini


def refuse_shadows() -> None:
    """Raise ImportError if a module of the tested project hides a package of tactile-cell."""
    home, spec = Path(__file__).resolve().parents[1], find_spec("cell")
    if spec is None or Path(spec.origin or "").resolve() != home / "cell" / "__init__.py":
        raise ImportError(
            f"{spec and spec.origin} hides the package 'cell' of tactile-cell in {home}: it comes "
            "first on sys.path; rename it, or start pytest in another folder"
        )
    from cell.installation import refuse_shadows as refuse_others

    refuse_others()


_VALUES = (
    (
        "--cell-config",
        "FILE",
        "config of the cell under test (also ini option cell_config): IDs, rates, node; its ports "
        "are not used",
    ),
    ("--servo-port", "PATH", "real servos on this serial port, for example /dev/ttyUSB0"),
    (
        "--can-interface",
        "NAME",
        "real control unit on this python-can interface, for example socketcan or slcan",
    ),
    ("--can-channel", "NAME", "channel of the interface, for example can0"),
)
"""Options with a value: name, metavar and help."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the group ``tactile-cell``."""
    group = parser.getgroup(
        "tactile-cell", "tactile-cell: cell under test; without ports the simulated cell"
    )
    for option, metavar, text in _VALUES:
        group.addoption(option, metavar=metavar, help=text)
    group.addoption(
        "--allow-motion",
        action="store_true",
        help="allow tests to switch on the torque of real servos; the grip must be empty",
    )
    group.addoption(
        "--contract",
        metavar="KIND[:NAME]",
        action="append",
        default=[],
        help=f"run the contract tests of installed plugins: {', '.join(CONTRACTS)}",
    )
    parser.addini("cell_config", "config of the cell under test", type="string", default="")


def pytest_configure(config: pytest.Config) -> None:
    """Register the mark of the contracts, and refuse incomplete options."""
    config.addinivalue_line("markers", "slow: more than 0.3 s of processor")
    options = HardwareOptions.of(config)
    if (options.can_interface is None) != (options.can_channel is None):
        raise pytest.UsageError("--can-interface and --can-channel need each other: name both")
    kinds = [text.partition(":")[0] for text in config.getoption("contract")]
    for kind in kinds:
        if kind not in CONTRACTS:
            raise pytest.UsageError(f"no contract {kind!r}; there are {', '.join(CONTRACTS)}")
    if kinds:
        try:
            refuse_shadows()
        except ImportError as error:
            raise pytest.UsageError(str(error)) from error
    if kinds and config.args_source is not pytest.Config.ArgsSource.ARGS:
        config.args = []
    folder = Path(__file__).with_name("contracts")
    config.args += [str(folder / f"{kind}.py") for kind in dict.fromkeys(kinds)]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each test of a contract on each plugin of its kind, or on the one that is named."""
    if "plugin_name" not in metafunc.fixturenames:
        return
    from cell.plugins import GROUPS

    kind = metafunc.module.__name__.rpartition(".")[2]
    available = list(next(group for group in GROUPS if group.what == kind.replace("_", " ")))
    texts = [text.partition(":") for text in metafunc.config.getoption("contract")]
    names = [name for what, _, name in texts if what == kind and name]
    for name in names:
        if name not in available:
            raise pytest.UsageError(f"no {kind} {name!r} is installed; there are {available}")
    metafunc.parametrize("plugin_name", names or available, scope="module")


def pytest_report_header(config: pytest.Config) -> list[str]:
    """Return a line with the hardware under test; empty if all devices are simulated."""
    options = HardwareOptions.of(config)
    devices = []
    if options.servo_port is not None:
        devices.append(f"servos at {options.servo_port}")
    if options.can_interface is not None:
        devices.append(f"control unit at {options.can_interface} {options.can_channel}")
    if not devices:
        return []
    motion = "may move" if options.allow_motion else "must not move (no --allow-motion)"
    return [f"tactile-cell: REAL HARDWARE: {', '.join(devices)}; servos {motion}"]
