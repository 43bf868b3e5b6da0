"""A Viam module: the cell as a gripper, and by do_command as something that names what it holds."""

import asyncio

from viam.components.gripper import Gripper
from viam.module.module import Module
from viam.resource.easy_resource import EasyResource
from viam.utils import struct_to_dict

from cell.control.states import CellState
from cell.errors import NoPartFound
from cell.interfaces.plugin.plugin import JobFailed, TactileCellPlugin

LONGEST_S = 600.0  # of one job; a caller that gives up earlier has it stopped


def whole(fields):
    """Numbers of Viam are all floats: whole ones as int, for fields that count."""
    numbers = {k: v for k, v in fields.items() if isinstance(v, float) and v.is_integer()}
    return {**fields, **{name: int(value) for name, value in numbers.items()}}


class TactileGripper(Gripper, EasyResource):
    """A gripper of Viam: only `open` lets a part go; no error, stop or end of the module does."""

    MODEL = "tactile-cell:gripper:cell"

    @classmethod
    def validate_config(cls, config):
        unknown = set(struct_to_dict(config.attributes)) - {"config", "model", "grip_force_n"}
        if unknown:
            raise ValueError(f"unknown: {', '.join(sorted(unknown))}")
        return [], []

    @classmethod
    def new(cls, config, dependencies):
        self = super().new(config, dependencies)
        given = struct_to_dict(config.attributes)
        self.force_n = given.get("grip_force_n", 5.0)
        self.cell = TactileCellPlugin(given.get("config"), model=given.get("model"))
        self.job = None
        return self

    async def open(self, *, extra=None, timeout=None, **kwargs):
        await asyncio.to_thread(self.cell.release)

    async def grab(self, *, extra=None, timeout=None, **kwargs):
        try:
            goal = {"task": "grip", "force_n": self.force_n, **whole(extra or {})}
            return (await self.run(goal)).held
        except JobFailed as failed:
            if isinstance(failed.__cause__, NoPartFound):
                return False
            raise

    async def is_holding_something(self, *, extra=None, timeout=None, **kwargs):
        status = self.cell.status()
        meta = {"state": status.state, "fault": status.fault or "", "number": status.fault_number}
        return self.HoldingStatus(is_holding_something=status.holding, meta=meta)

    async def stop(self, *, extra=None, timeout=None, **kwargs):
        if self.job is not None:
            self.cell.cancel(self.job)

    async def is_moving(self):
        return CellState(self.cell.state()).acting

    async def do_command(self, command, *, timeout=None, **kwargs):
        """Run {"task": "identify", "keep": "always"}, or teach, verify, clear, reset."""
        if command.get("task") in ("clear", "reset"):
            await asyncio.to_thread(getattr(self.cell, command["task"]))
            return {"state": self.cell.state()}
        answer = await self.run(whole(command))
        if command["task"] == "identify":
            size_mm = answer.shape.size_mm if answer.shape else 0.0
            return {
                "label": answer.label,
                "probability": answer.probability,
                "size_mm": size_mm,
                "kept": answer.kept,
            }
        if command["task"] == "teach":
            return {"grasps": answer, "labels": list(self.cell.labels)}
        return {"held": answer.held, "same": bool(answer.same)}

    async def run(self, goal):
        """Run a job to its end; it is stopped with the part held if the caller goes away."""
        self.job = self.cell.start(goal)
        try:
            return await asyncio.to_thread(self.cell.result, self.job, LONGEST_S)
        except asyncio.CancelledError:
            self.cell.cancel(self.job)
            raise

    async def close(self):
        await asyncio.to_thread(self.cell.close)

    async def get_kinematics(self, **kwargs):
        raise NotImplementedError("the fingers are not part of a kinematic chain")

    async def get_current_inputs(self, **kwargs):
        raise NotImplementedError("the fingers are not part of a kinematic chain")

    async def go_to_inputs(self, values, **kwargs):
        raise NotImplementedError("the fingers are commanded by force: use grab")


if __name__ == "__main__":
    asyncio.run(Module.run_from_registry())
