"""Whatever comes over the wire, the servos go on: no exception, no broken answer, no lost limit."""

from hypothesis import given, settings, strategies as st

from gripper.dynamixel.models import MODELS
from simulator.servo.bus import ServoBusDevice
from simulator.servo.device import SimulatedServo
from simulator.servo.motor import ServoMotor
from simulator.servo.protocol2 import Instruction, PacketParser, encode_instruction

models = st.sampled_from(list(MODELS.values()))
addresses = st.integers(0, 240) | st.integers(560, 720)
single = st.tuples(
    st.integers(0, 3) | st.just(0xFE),
    st.sampled_from([*Instruction, 0x77]),
    st.binary(max_size=12)
    | st.builds(
        lambda address, data: address.to_bytes(2, "little") + data,
        addresses,
        st.binary(min_size=1, max_size=8) | st.integers(0, 3).map(lambda v: bytes((v,))),
    ),
)


def make(model) -> tuple[ServoBusDevice, list[ServoMotor]]:
    motors = [ServoMotor(model), ServoMotor(model)]
    servos = [
        SimulatedServo(i, model, motor, settings={"baud_rate": 3, "operating_mode": 5})
        for i, motor in enumerate(motors, start=1)
    ]
    return ServoBusDevice(servos, 1_000_000), motors


@settings(max_examples=150, derandomize=True, deadline=None)
@given(models, st.lists(single, max_size=25), st.floats(0.0, 0.5))
def test_any_instruction_is_survived(model, packets, pause_s: float):
    device, motors = make(model)
    now_s = 0.0
    for packet_id, instruction, parameters in packets:
        now_s += pause_s
        device.receive(encode_instruction(packet_id, instruction, parameters), now_s)
        answer = device.transmit(now_s + 1.0)
        assert all(p.intact for p in PacketParser().push(answer))
        for motor, servo in zip(motors, device.servos, strict=True):
            motor.torque_nm(0.001)
            registers = servo.core.registers
            assert abs(registers.get("goal_current")) <= registers.model.current_limit_raw
            assert registers.get("operating_mode") in {0, 1, 3, 4, 5, 16}
            assert registers.get("model_number") == model.number
