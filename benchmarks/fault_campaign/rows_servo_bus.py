"""Rows 18 to 21: answers that are lost, damaged or of nobody, a dead bus, one silent finger."""

from benchmarks.fault_campaign.row import FaultRow
from benchmarks.fault_campaign.servo_jobs import grasp_row

PERIOD_S = 0.005
_LOST_BUS_S = 0.1
_ONE_SIDED_S = 0.025
"""Three periods with their repetitions, and what is left of the one in which it began."""

BUS_ROWS: tuple[FaultRow, ...] = (
    grasp_row(
        18,
        "one lost answer",
        "one answer of a servo is lost in the ramp",
        "servos.loss=1@contact+0.2s..contact+203ms",
        "NOTE",
        PERIOD_S,
    ),
    grasp_row(
        18,
        "one lost request",
        "one request to the servos is lost in the ramp",
        "servos.lost_requests=1@contact+0.2s..contact+203ms",
        "NOTE",
        PERIOD_S,
    ),
    grasp_row(
        18,
        "now and then",
        "one answer in twenty is lost, for the whole job",
        "servos.loss=0.05",
        "NOTE",
        None,
    ),
    grasp_row(
        19,
        "cable out",
        "the cable of the servo bus is pulled in the ramp",
        "servos.unplugged@contact+0.2s",
        "HOLD",
        _LOST_BUS_S,
    ),
    grasp_row(
        19,
        "dead bus",
        "no servo answers any more in the ramp",
        "servos.off@contact+0.2s",
        "HOLD",
        _LOST_BUS_S,
    ),
    grasp_row(
        19,
        "dead bus in the approach",
        "no servo answers any more while the fingers close",
        "servos.off@moving+0.6s",
        "HOLD",
        _LOST_BUS_S,
    ),
    grasp_row(
        19,
        "all answers late",
        "all answers come 30 ms late from the ramp on",
        "servos.delayed=0.03@contact+0.2s",
        "HOLD",
        _LOST_BUS_S,
    ),
    grasp_row(
        20,
        "bit errors",
        "one bit of every answer turns for 10 ms",
        "servos.corrupt=1@contact+0.2s..contact+0.21s",
        "NOTE",
        PERIOD_S,
    ),
    grasp_row(
        20,
        "bit errors now and then",
        "one bit of one answer in twenty turns, for the whole job",
        "servos.corrupt=0.05",
        "NOTE",
        None,
    ),
    grasp_row(
        20,
        "cut answers",
        "all answers lack their end from the ramp on",
        "servos.truncated=1@contact+0.2s",
        "HOLD",
        _LOST_BUS_S,
    ),
    grasp_row(
        20,
        "wrong sender",
        "answers name another servo for 4 ms",
        "servos.wrong_id=1@contact+0.2s..contact+204ms",
        "NOTE",
        PERIOD_S,
    ),
    grasp_row(
        20,
        "noise before answers",
        "bytes of noise come before every answer, for the whole job",
        "servos.garbage=1",
        "NOTE",
        None,
    ),
    grasp_row(
        20,
        "own echo",
        "the adapter gives the host its own bytes back, for the whole job",
        "servos.echo",
        "NOTE",
        None,
    ),
    grasp_row(
        21,
        "second finger in the ramp",
        "servo 2 falls silent in the ramp, servo 1 answers",
        "servo2.off@contact+0.2s",
        "HOLD",
        _ONE_SIDED_S,
    ),
    grasp_row(
        21,
        "first finger in the ramp",
        "servo 1 falls silent in the ramp, servo 2 answers",
        "servo1.off@contact+0.2s",
        "HOLD",
        _ONE_SIDED_S,
    ),
    grasp_row(
        21,
        "in the approach",
        "servo 2 falls silent while the fingers close",
        "servo2.off@moving+0.6s",
        "HOLD",
        _ONE_SIDED_S,
    ),
)
