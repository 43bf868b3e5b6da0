"""Two simulated servos on a pseudo-terminal, as a process of its own: python -m ...

Unlike the simulated cell it steps no mechanics, so that only the bus is measured, and it can answer
at once: the wire time that a line of 1 Mbit/s takes is then left out. It prints the terminal's path
and then obeys lines of JSON on its standard input, ``{"paced": bool, "drop_every": n}``, until that
ends.
"""

import json
import os
import select
import sys
import time
import tty

from gripper.dynamixel.models import XM430_W350
from simulator.servo.bus import ServoBusDevice
from simulator.servo.device import BAUD_RATES, SimulatedServo
from simulator.servo.motor import ServoMotor

BAUD_RATE = 1_000_000
SERVO_IDS = (1, 2)


def _device() -> ServoBusDevice:
    eeprom = {"baud_rate": BAUD_RATES.index(BAUD_RATE), "return_delay_time": 0}
    servos = []
    for servo_id in SERVO_IDS:
        motor = ServoMotor(XM430_W350)
        motor.angle_rad = 3.0 + 0.1 * servo_id
        motor.velocity_rad_s, motor.current_a = -0.5 * servo_id, -0.1 * servo_id
        servos.append(SimulatedServo(servo_id, XM430_W350, motor, settings=eeprom))
    return ServoBusDevice(servos, BAUD_RATE)


class Responder:
    """Moves bytes between a terminal and the servos, at once or at the rate of the line."""

    def __init__(self, device: ServoBusDevice, descriptor: int) -> None:
        self._device = device
        self._descriptor = descriptor
        self._ahead_s = 0.0
        self.paced = False

    def answer(self) -> None:
        """Take what has come and send all answers to it."""
        device = self._device
        now_s = time.monotonic() + self._ahead_s
        device.receive(os.read(self._descriptor, 4096), now_s)
        while (due_s := device.next_event_s()) is not None:
            if due_s > now_s:
                if self.paced:
                    select.select([], [], [], due_s - now_s)
                    now_s = max(due_s, time.monotonic() + self._ahead_s)
                else:
                    # The servos' time runs ahead of the clock by the wire time that is left out.
                    self._ahead_s += due_s - now_s
                    now_s = due_s
            os.write(self._descriptor, device.transmit(now_s))


def main() -> None:
    device = _device()
    master, slave = os.openpty()
    tty.setraw(slave)
    responder = Responder(device, master)
    print(json.dumps({"port": os.ttyname(slave)}), flush=True)
    while True:
        readable, _, _ = select.select([master, sys.stdin], [], [])
        if master in readable:
            responder.answer()
        if sys.stdin in readable:
            text = sys.stdin.readline()
            if not text:
                return
            wish = json.loads(text)
            responder.paced = wish["paced"]
            device.faults.reset()
            device.faults.drop.every = wish["drop_every"]
            print("{}", flush=True)


if __name__ == "__main__":
    main()
