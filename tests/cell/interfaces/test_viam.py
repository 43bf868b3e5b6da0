"""The Viam module of docs/examples, over gRPC as viam-server calls it, on the simulated cell."""

import asyncio
import importlib.util
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("viam", reason="viam-sdk is not installed")

from grpclib import GRPCError
from grpclib.testing import ChannelFor
from viam.components.gripper import Gripper, GripperClient
from viam.components.gripper.service import GripperRPCService
from viam.proto.app.robot import ComponentConfig
from viam.resource.manager import ResourceManager
from viam.resource.registry import Registry
from viam.utils import dict_to_struct

from tests.cell.interfaces.conftest import LIMIT_S, grip_n

pytestmark = pytest.mark.anyio
EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "viam"
CONFIG = """\
self_zero: on_demand
tactile: {tare_frames: 25}
simulator:
  objects:
    - {label: ball, shape: "sphere:diameter=9.5mm"}
    - {label: box, shape: "box:length=15.9mm,width=10mm,height=10mm"}
"""
KEEP = {"task": "identify", "present": "ball", "max_grasps": 1, "keep": "always"}


@pytest.fixture(scope="module")
def registered() -> Any:
    """Load the module, which registers its model, once."""
    spec = importlib.util.spec_from_file_location("viam_example", EXAMPLE / "tactile_gripper.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    (model,) = json.loads((EXAMPLE / "meta.json").read_text())["models"]
    assert model["model"] == str(module.TactileGripper.MODEL)
    Registry.lookup_resource_creator(Gripper.API, module.TactileGripper.MODEL)  # it is registered
    return module.TactileGripper


@pytest.fixture
async def on_viam(
    registered: Any, taught: Any, tmp_path: Path
) -> AsyncIterator[tuple[GripperClient, Any]]:
    """A client of Viam, and the gripper behind it."""
    (tmp_path / "cell.yaml").write_text(CONFIG)
    attributes = {"config": str(tmp_path / "cell.yaml"), "model": str(taught.result.model)}
    made = ComponentConfig(name="hand", attributes=dict_to_struct(attributes))
    gripper = registered.new(made, {})
    try:
        async with ChannelFor([GripperRPCService(ResourceManager([gripper]))]) as channel:
            yield GripperClient("hand", channel), gripper
    finally:
        await gripper.close()


async def test_grab_holds_until_open(on_viam: Any) -> None:
    client, gripper = on_viam
    assert not await client.grab()  # nothing is there
    assert not (await client.is_holding_something()).is_holding_something
    assert await client.grab(extra={"present": "ball"})
    assert (await client.is_holding_something()).is_holding_something
    assert not await client.is_moving()
    assert grip_n(gripper.cell) > 1.0
    await client.stop()
    assert grip_n(gripper.cell) > 1.0
    await client.open()
    assert not (await client.is_holding_something()).is_holding_something
    assert grip_n(gripper.cell) == 0.0


async def test_do_command_names_verifies_and_keeps(on_viam: Any) -> None:
    client, gripper = on_viam
    named = await client.do_command(KEEP)
    assert (named["label"], named["kept"]) == ("ball", True)
    assert 0.5 < float(named["probability"]) <= 1.0
    assert await client.do_command({"task": "verify"}) == {"held": True, "same": True}
    with pytest.raises(GRPCError):  # the part is still held
        await client.do_command(KEEP)
    assert grip_n(gripper.cell) > 1.0
    await client.open()
    taught = await client.do_command({"task": "teach", "label": "box", "grasps": 3, "seed": 4})
    assert taught == {"grasps": 3, "labels": ["ball", "box"]}


async def test_a_fault_and_a_caller_that_goes_away_keep_the_part(on_viam: Any) -> None:
    client, gripper = on_viam
    await client.do_command(KEEP)
    fault = gripper.cell._cell.simulated.inject("unit.off")
    with pytest.raises(GRPCError):
        await client.do_command({"task": "verify"})
    holding = await client.is_holding_something()
    assert holding.is_holding_something
    assert holding.meta is not None
    assert (holding.meta["state"], holding.meta["number"] > 0) == ("ABORTED", True)
    assert grip_n(gripper.cell) > 1.0
    fault.clear()
    assert await client.do_command({"task": "clear"}) == {"state": "RESETTING"}
    await client.open()
    assert await client.do_command({"task": "reset"}) == {"state": "IDLE"}
    goal = {"task": "teach", "label": "ball", "grasps": 500}
    asked = asyncio.create_task(gripper.do_command(goal))
    async with asyncio.timeout(LIMIT_S):
        while not await client.is_moving():
            await asyncio.sleep(0.01)
        asked.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asked
        # Between two grasps nothing moves, and the job still runs.
        while not gripper.cell.feedback(gripper.job).outcome.terminal:
            await asyncio.sleep(0.01)
    assert gripper.cell.feedback(gripper.job).outcome == "CANCELED"


def test_unknown_attributes_are_refused(registered: Any) -> None:
    given = dict_to_struct({"confg": "cell.yaml"})
    with pytest.raises(ValueError, match="confg"):
        registered.validate_config(ComponentConfig(name="hand", attributes=given))
