"""Random texts of faults: every name of the vocabulary, any value, any moment."""

from hypothesis import strategies as st

from simulator.faults import VOCABULARY
from simulator.faults_entry import FaultEntry, Number

_GENTLE = {
    "can.flood": (10.0, 2000.0),
    "can.delayed": (0.001, 0.5),
    "unit.slow": (0.001, 0.05),
    "object.slips": (5.0, 200.0),
    "servoN.supply": (5.0, 16.0),
    "servoN.jump": (-0.5, 0.5),
    "taxels.offset": (-60.0, 60.0),
    "taxels.gain": (0.0, 3.0),
    "taxels.saturated": (0.0, 1.0),
}
"""Where most of a fault's range is of no interest, the part that is drawn from."""
_SETTINGS = (
    "servoN.wrong=operating_mode:1",
    "servoN.wrong=current_limit:100",
    "servoN.wrong=temperature_limit:40",
    "servoN.wrong=shutdown:0",
    "servoN.wrong=return_delay_time:250",
    "servoN.wrong=baud_rate:1",
    "unit.wrong=serial:99",
    "unit.wrong=product:7",
    "unit.wrong=taxels:400",
)


def _values(entry: FaultEntry) -> st.SearchStrategy[str]:
    if entry.value is None:
        return st.just(entry.name)
    if not isinstance(entry.value, Number):
        return st.sampled_from([text for text in _SETTINGS if text.startswith(entry.name)])
    low, high = _GENTLE.get(entry.name, (entry.value.low, entry.value.high))
    if entry.value.whole:
        number = st.integers(int(low), int(high)).map(str)
    else:
        number = st.floats(low, high).map(lambda value: f"{value:.4g}")
    return st.one_of(st.just(entry.name), number.map(lambda value: f"{entry.name}={value}"))


def _windows(entry: FaultEntry) -> st.SearchStrategy[str]:
    at = st.one_of(
        st.just(""),
        st.integers(0, 900).map(lambda ms: f"@{ms}ms"),
        st.integers(0, 300).map(lambda ms: f"@contact+{ms}ms"),
        st.just("@moving"),
    )
    if entry.moment:
        return at
    timed = st.tuples(st.integers(0, 900), st.integers(10, 600)).map(
        lambda pair: f"@{pair[0]}ms..{pair[0] + pair[1]}ms"
    )
    return st.one_of(at, timed)


def fault_texts() -> st.SearchStrategy[str]:
    """Return texts of every fault of the vocabulary, at random moments."""

    def of(entry: FaultEntry) -> st.SearchStrategy[str]:
        text = st.tuples(_values(entry), _windows(entry)).map("".join)
        if not entry.name.startswith("servoN"):
            return text
        number = st.sampled_from(("servo1", "servo2"))
        return st.tuples(number, text).map(lambda pair: pair[1].replace("servoN", pair[0]))

    return st.sampled_from(sorted(VOCABULARY)).flatmap(lambda name: of(VOCABULARY[name]))
