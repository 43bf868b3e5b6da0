"""Backup of a cell: one file with all data of the cell, and its restore.

A zip archive without compression. Its first member, manifest.json, has format, versions, the
control tables of the servos, the objects of the control unit, and the checksum of each member.
"""

import os
import platform
import re
import shutil
import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, BinaryIO

from pydantic import BaseModel, ValidationError

from cell.checks.findings import STORE_NAME, ProposedChange
from cell.commissioning.backup import (
    Backup,
    backup_file,
    read_control_table,
    restore as restore_servos,
)
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog
from cell.commissioning.record import RECORD_NAME
from cell.commissioning.unit import restore_unit_values, unit_values
from cell.config.file import (
    MAX_BYTES,
    config_file_text,
    parse_config,
    problem_text,
    text_with_values,
)
from cell.config.model import CellConfig
from cell.control.self_zero import zero_file
from cell.data.files import DAMAGE, free_name, open_plain, write_atomically
from cell.data.formats import (
    CELL_BACKUP,
    KEPT_BYTES,
    SERVO_BACKUP,
    checksum,
    json_text,
    parse_json,
    write_json as write_kept,
)
from cell.errors import CellError, ConfigError, reason_text
from gripper.errors import GripperError
from tactile.errors import TactileError

MANIFEST = "manifest.json"
"""First member of a backup."""
UNDO = "restore-undo.zip"
"""Backup of the files that the last restore replaced, in the folder of the cell."""
MAX_MEMBERS = 5000
"""Most files of a backup: data set, model and photo of each of a thousand objects, and more."""
PORTS = (
    *("gripper.port", "tactile.interface", "tactile.channel", "tactile.sensor.ports"),
    *("positioner.can.interface", "positioner.can.channel", "positioner.socket"),
)
"""Keys of the config for devices of this machine; a restore does not change them."""
_KEPT = (STORE_NAME, RECORD_NAME, "backup-servo*.json", "*.npz", "*.photos/*.jpg", "*.photos/*.png")
"""Files of a cell in its folder, beside its config."""
_NAME = re.compile(
    r"cell/([\w-][\w .-]*\.photos/)?[\w-][\w .-]*\.(yaml|yml|json|html|npz|jpg|png)"
    r"|jobs/self-zero-[\w-]*\.json"
)
"""Name of a member: a file in the folder of the cell, or the self-zero in that of its jobs."""
_PIECE_BYTES = 1 << 20
_MOST_SHOWN = 40
"""Keys of the config whose differences are shown one by one."""


class Member(BaseModel):
    """Entry of a file in the manifest."""

    n_bytes: int
    sha256: str


class Manifest(BaseModel):
    """Description of a backup."""

    name: str
    """Of the cell."""
    made: str
    """Wall-clock time (ISO 8601, UTC)."""
    versions: dict[str, str]
    """Of program, Python and system."""
    config: str
    """Member that is the config."""
    directory: str
    """Folder of the jobs, ``recording.directory``."""
    members: dict[str, Member]
    undo: bool = False
    """Whether it has the files that a restore replaced; it is then restored exactly."""
    absent: list[str] = []
    """Files that did not exist then; they are removed."""
    servos: list[Backup] = []
    """Control table of each servo at the time of the backup."""
    control_unit: dict[str, Any] = {}
    """Identity, layout and objects of the control unit; empty if not read."""
    missing: list[str] = []
    """Device data that could not be read, and why."""


def back_up(
    path: Path, config_file: Path, config: CellConfig, *, models: Sequence[Path] = (),
    bench: Bench | None = None,
) -> Manifest:  # fmt: skip
    """Write all data of a cell to one file; return its manifest.

    Parameters
    ----------
    path
        The new file; an existing one is never overwritten.
    config_file, config
        The cell; its folder has findings, record, backups of the servos, models and data sets.
    models
        Models in other folders, with their data sets and photos.
    bench
        Reads control tables and objects of the devices; None: they are omitted. A device that does
        not answer is in ``missing``.

    Raises CellError if a file cannot be read or written.
    """
    if os.path.lexists(path):
        raise CellError(f"{path} exists; backups are never overwritten, name another file")
    folder = config_file.parent
    files = [(f"cell/{config_file.name}", config_file)]
    files += [(f"cell/{one.relative_to(folder).as_posix()}", one) for one in _own(folder, _KEPT)]
    for model in models:
        photos = model.with_name(f"{model.stem}.photos").glob("*.???")
        grasps = model.with_name(f"{model.stem}.grasps.npz")
        found = (model, *(one for one in (grasps, *sorted(photos)) if one.is_file()))
        files += [(f"cell/{one.relative_to(model.parent).as_posix()}", one) for one in found]
    zero = zero_file(Path(config.recording.directory), config.name)
    files += [(f"jobs/{zero.name}", zero)] if zero.is_file() else []
    names = dict(files)
    for name, source in files:
        if names[name].resolve() != source.resolve():
            raise CellError(f"{names[name]} and {source} have the same name; rename one of them")
        if not _NAME.fullmatch(name):
            raise CellError(f"{source} has an unsupported name; rename it to plain letters")
    found_devices = {} if bench is None else _devices(bench, config)
    return _write(path, names, found_devices | {
        "name": config.name, "config": files[0][0], "directory": config.recording.directory,
    })  # fmt: skip


def _own(folder: Path, patterns: Iterable[str]) -> Iterator[Path]:
    for pattern in patterns:
        yield from (path for path in sorted(folder.glob(pattern)) if path.is_file())


def _devices(bench: Bench, config: CellConfig) -> dict[str, Any]:
    """Return the stored values of the devices; only reads."""
    servos, unit, missing = list[Backup](), dict[str, Any](), list[str]()
    if config.simulated:
        return {"missing": ["the devices are simulated"]}
    rate = config.gripper.baud_rate
    for servo in config.gripper.servos:
        try:
            with bench.servo_bus() as bus:
                found = read_control_table(bus, servo.id)
            servos.append(Backup(servo_id=servo.id, baud_rate=rate, found=found))
        except GripperError as error:
            missing.append(f"registers of servo {servo.id}: {error}")
    try:
        # Where another program has the servos, its requests to the unit are not disturbed.
        boards = not config.tactile.sensor.canopen
        unit = {} if missing or boards else unit_values(bench)
        missing += ["objects of the control unit: the servos come first"] if missing else []
    except TactileError as error:
        missing.append(f"objects of the control unit: {error}")
    return {"servos": servos, "control_unit": unit, "missing": missing}


def _write(path: Path, files: Mapping[str, Path], facts: Mapping[str, Any]) -> Manifest:
    """Write a backup. A file is read twice; one that changed between is refused."""
    members = {}
    for name, source in files.items():
        with open_plain(source, error=CellError, what="file") as file:
            size = os.fstat(file.fileno()).st_size
            members[name] = Member(n_bytes=size, sha256=checksum(_pieces(file)))
    manifest = Manifest(
        **facts,
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        versions={"tactile-cell": version("tactile-cell"), "python": platform.python_version(),
                  "system": f"{platform.system()} {platform.release()}"},
        members=members,
    )  # fmt: skip

    def write(out: BinaryIO) -> None:
        with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
            text = json_text(CELL_BACKUP, manifest.model_dump(mode="json"))
            archive.writestr(MANIFEST, text)
            for name, source in files.items():
                with (
                    open_plain(source, error=CellError, what="file") as file,
                    archive.open(zipfile.ZipInfo(name), "w", force_zip64=True) as member,
                ):
                    if checksum(_copied(file, member)) != members[name].sha256:
                        raise CellError(f"{source} has just changed; make the backup again")

    write_atomically(path, write, error=CellError, what="backup")
    return manifest


def _pieces(file: IO[bytes]) -> Iterator[bytes]:
    while piece := file.read(_PIECE_BYTES):
        yield piece


def _copied(source: IO[bytes], target: IO[bytes]) -> Iterator[bytes]:
    for piece in _pieces(source):
        target.write(piece)
        yield piece


@dataclass(frozen=True, slots=True)
class OpenBackup:
    """A backup that was read and is whole."""

    manifest: Manifest
    _archive: zipfile.ZipFile

    def open(self, name: str) -> IO[bytes]:
        """Open a member for reading."""
        return self._archive.open(name)


@contextmanager
def open_backup(path: Path) -> Iterator[OpenBackup]:
    """Read all of a backup and compare it with its checksums.

    Raises CellError if it is damaged, of another format, or not made by `back_up`: a member with
    another name or compression, or a size beyond that of the file.
    """
    with ExitStack() as opened:
        file = opened.enter_context(open_plain(path, error=CellError, what=CELL_BACKUP.what))
        try:
            archive = opened.enter_context(zipfile.ZipFile(file))
            manifest = _checked(path, archive, os.fstat(file.fileno()).st_size)
        except (*DAMAGE, OSError, struct.error) as error:
            raise CellError(
                f"{path} is damaged ({reason_text(error)}); {CELL_BACKUP.remedy}"
            ) from error
        yield OpenBackup(manifest, archive)


def _checked(path: Path, archive: zipfile.ZipFile, n_bytes: int) -> Manifest:
    infos = {info.filename: info for info in archive.infolist()}
    total = sum(info.file_size for info in infos.values())
    packed = any(info.compress_type != zipfile.ZIP_STORED for info in infos.values())
    wrong = ""
    if MANIFEST not in infos or infos[MANIFEST].file_size > KEPT_BYTES:
        wrong = f"it has no {MANIFEST} of at most {KEPT_BYTES} bytes"
    elif packed or total > n_bytes or not len(archive.infolist()) == len(infos) <= MAX_MEMBERS:
        wrong = f"it is compressed, has a file twice, or more than {MAX_MEMBERS} files"
    if wrong:
        raise CellError(f"{path} is not a {CELL_BACKUP.what}: {wrong}; {CELL_BACKUP.remedy}")
    text = archive.read(MANIFEST)
    try:
        values = parse_json(text, CELL_BACKUP, path, error=CellError)
        manifest = Manifest.model_validate(values)
    except ValidationError as error:
        raise CellError(
            f"{path} is damaged ({problem_text(error)}); {CELL_BACKUP.remedy}"
        ) from error
    named = {*manifest.members, *manifest.absent}
    if bad := next((name for name in sorted(named) if not _NAME.fullmatch(name)), None):
        raise CellError(f"{path} has {bad!r:.80}, not a file of a cell; {CELL_BACKUP.remedy}")
    if manifest.members.keys() != infos.keys() - {MANIFEST}:
        raise CellError(f"{path} is damaged: files are missing or added; {CELL_BACKUP.remedy}")
    for name, member in manifest.members.items():
        with archive.open(name) as stream:
            if checksum(_pieces(stream)) != member.sha256:
                raise CellError(
                    f"{path} is damaged: the checksum of {name} is wrong; {CELL_BACKUP.remedy}"
                )
    for wrong in filter(None, (servo.wrong() for servo in manifest.servos)):
        raise CellError(f"{path} is damaged: {wrong} of a servo; {CELL_BACKUP.remedy}")
    return manifest


def restore(
    path: Path, folder: Path, approve: Callable[[Sequence[ProposedChange]], object]
) -> list[str]:
    """Restore the files of a backup in a folder; return the results as lines.

    Nothing is written before the whole backup is read and the changes are approved. Replaced files
    are saved to `UNDO` first; a restore of `UNDO` reverts all. Otherwise the ports of the present
    config stay, if both configs are of real cells. Raises CellError as `open_backup`, or if a file
    cannot be written.
    """
    with open_backup(path) as backup:
        manifest = backup.manifest
        places = {name: _place(name, folder, manifest) for name in manifest.members}
        config, kept = _config_for(backup, places.get(manifest.config))
        changes, differing = list[ProposedChange](), dict[str, Path]()
        for name, place in places.items():
            new = manifest.members[name]
            if name == manifest.config:
                new = Member(n_bytes=len(config), sha256=checksum([config]))
            before = _member(place)
            if before == new:
                continue
            differing[name] = place
            shown = _config_changes(place, config, folder) if name == manifest.config else ()
            changes += shown or (_change(place, _text(before), _text(new), folder),)
        gone = {name: _place(name, folder, manifest) for name in manifest.absent}
        gone = {name: place for name, place in gone.items() if place.exists()}
        changes += [_change(place, _text(_member(place)), "removed", folder)
                    for place in gone.values()]  # fmt: skip
        if not changes:
            return ["all files are as in the backup"]
        approve([*changes])
        _keep_undo(folder, manifest, differing | gone)
        for name, place in differing.items():
            place.parent.mkdir(parents=True, exist_ok=True)
            with backup.open(name) as stream:
                source = BytesIO(config) if name == manifest.config else stream
                write_atomically(
                    place,
                    lambda file, source=source: shutil.copyfileobj(source, file),  # type: ignore[misc]
                    error=CellError,
                    what="file",
                )
        for place in gone.values():
            place.unlink()
        lines = [f"{len(differing)} files of {manifest.name} ({manifest.made}) are restored"]
        lines += [f"{len(gone)} files are removed"] if gone else []
        lines += [f"kept from this machine: {one}" for one in kept]
        return [*lines, "`tactile-cell restore --undo` reverts it"]


def restore_registers(path: Path, config: CellConfig, bench: Bench, dialog: Dialog) -> list[str]:
    """Write the EEPROM of each servo from a backup of the cell; return the results as lines.

    Raises as `open_backup` and `cell.commissioning.backup.restore`.
    """
    with open_backup(path) as backup, TemporaryDirectory() as folder:
        for servo in backup.manifest.servos:
            write_kept(
                backup_file(Path(folder), servo.servo_id), SERVO_BACKUP, servo, error=CellError
            )
        if not backup.manifest.servos:
            raise CellError(
                f"{path} has no registers of servos; choose a backup without --no-devices"
            )
        there = Bench(Path(folder), bench.lines, base=config)
        return list(restore_servos(there, dialog, config.gripper.port))


def restore_unit(path: Path, bench: Bench, dialog: Dialog) -> list[str]:
    """Write the objects of the control unit as a backup of the cell has them; return what was done.

    No other program may have the servos meanwhile: it would use the unit, too. Raises as
    `open_backup`, and CellError where the backup has no objects, or those of another unit.
    """
    with open_backup(path) as backup, bench.servo_bus():
        if not backup.manifest.control_unit:
            raise CellError(f"{path} holds no objects of a control unit")
        try:
            return [restore_unit_values(bench, backup.manifest.control_unit, dialog)]
        except ValueError as error:
            wrong = problem_text(error) if isinstance(error, ValidationError) else error
            raise CellError(
                f"{path} is damaged, nothing was written ({wrong}); {CELL_BACKUP.remedy}"
            ) from error


def _place(name: str, folder: Path, manifest: Manifest) -> Path:
    where, _, rest = name.partition("/")
    return (folder if where == "cell" else Path(manifest.directory)) / rest


def _member(place: Path) -> Member | None:
    """Return size and checksum of a file; None without the file."""
    if not place.exists():
        return None
    with open_plain(place, error=CellError, what="file") as file:
        n_bytes = os.fstat(file.fileno()).st_size
        return Member(n_bytes=n_bytes, sha256=checksum(_pieces(file)))


def _text(member: Member | None) -> str:
    return "none" if member is None else f"{member.n_bytes} bytes, {member.sha256[:8]}"


def _change(place: Path, before: str, after: str, folder: Path, what: str = "") -> ProposedChange:
    undo = f"`tactile-cell restore --undo --folder {folder}`"
    return ProposedChange(where=str(place), what=what or "file", before=before, after=after,
                          undo=undo)  # fmt: skip


def _config_for(backup: OpenBackup, place: Path | None) -> tuple[bytes, list[str]]:
    """Return the config to write, and the ports that it keeps from the present one."""
    name = backup.manifest.config
    if place is None:
        return b"", []
    with backup.open(name) as stream:
        data = stream.read(MAX_BYTES + 1)
    if backup.manifest.undo or not place.exists():
        return data, []
    text = data.decode()
    coming = parse_config(text, source=name)
    try:
        present = parse_config(config_file_text(place), source=str(place))
    except ConfigError:
        return text.encode(), []  # the present config is not valid
    if present.simulated or coming.simulated:
        return text.encode(), []
    here, there = (_flat(one.model_dump(mode="json")) for one in (present, coming))
    both = (key for key in PORTS if key in here and key in there)
    kept = {key: here[key] for key in both if here[key] != there[key]}
    if kept:
        text = text_with_values(text, kept, source=name)
    return text.encode(), [f"{key} {value}" for key, value in kept.items()]


def _flat(values: Any, way: str = "") -> dict[str, Any]:
    """Return the plain values of a config by dotted key."""
    if not isinstance(values, dict):
        return {way: values}
    inner = (_flat(value, f"{way}.{name}".lstrip(".")) for name, value in values.items())
    return {key: value for one in inner for key, value in one.items()}


def _config_changes(place: Path, config: bytes, folder: Path) -> list[ProposedChange]:
    """Return the keys of a config that change; empty if too many, or if it cannot be read."""
    try:
        texts = config_file_text(place), config.decode()
        before, after = (
            _flat(parse_config(text, source=str(place)).model_dump(mode="json")) for text in texts
        )
    except CellError:
        return []
    keys = [key for key in before | after if before.get(key) != after.get(key)]
    if len(keys) > _MOST_SHOWN:
        return []
    return [_change(place, str(before.get(key)), str(after.get(key)), folder, key) for key in keys]


def _keep_undo(folder: Path, manifest: Manifest, places: Mapping[str, Path]) -> None:
    """Save the files that a restore replaces or removes to `UNDO`; an earlier `UNDO` is kept."""
    there = {name: place for name, place in places.items() if place.exists()}
    absent = [name for name in places if name not in there]
    facts = {"name": manifest.name, "config": manifest.config, "directory": manifest.directory,
             "undo": True, "absent": absent}  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / UNDO
    if path.exists():
        path.rename(free_name(path))
    _write(path, there, facts)
