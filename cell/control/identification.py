"""The grasp-then-classify sequence: grasp, classify, then stop or grasp again."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from cell.control.plan import GraspStep, Keep
from cell.control.records import GraspRecord
from cell.fault_catalogue import error_text
from recognition.drift.drift import DriftFollowing, DriftGrid
from recognition.errors import RecognitionError
from recognition.grasp import Grasp
from recognition.recognizer import Posterior, Recognizer
from recognition.shape.answer import ShapeAnswer, fuse_shapes
from recognition.statistics.fusion import Decision, DecisionKind, StopRule, decide, fuse

SAME_GRIP_DEPENDENCE = 0.5
"""Correlation of the log answers of a further ramp in the same grip with the ramps before. Pose and
part are the same; only the noise of the frames differs. Averaged with that of the first ramp (0.2),
three ramps count as with 0.4, which is likeliest for 40 simulated parts (touch alone, twice the
noise; 0.2 at the usual noise)."""

_SHARES = (0.5, 0.75)
"""Shares of its force at which a ramp is checked."""
_MOST_UNKNOWN = 0.02
"""Largest probability of an untaught object with which a ramp ends. With that of a sequence up to
3 % more of them got a name (docs/decisions/0010-unknown-never-ends-a-ramp.md)."""

ReadShape = Callable[[Grasp], ShapeAnswer | None]
"""Function from a grasp to its shape and size; None if the pads do not show them."""


class EarlyDecider:
    """Decides on one ramp while it runs, with the recognizer of whole ramps.

    Its levels are shares of the load that is reached, so it also answers for a part of a ramp.

    Parameters
    ----------
    earlier
        Posteriors of the earlier grasps of the same object, used together with this one.
    rule
        Rule for sufficient evidence, see `StopRule.suffices`; the limit of an untaught object is
        lower here. An untaught object never ends a ramp. An object whose name would be given only
        because this is the last grasp does not end one either.
    """

    def __init__(
        self, recognizer: Recognizer, earlier: Sequence[Posterior], rule: StopRule
    ) -> None:
        self._recognizer = recognizer
        self._earlier = tuple(earlier)
        self._rule = rule
        self._shares = list(_SHARES)
        self.answer: Posterior | None = None
        """Posterior of this grasp alone at the check that satisfied the rule; None until then."""
        self.error: Exception | None = None
        """Error of a check. The ramp continues, because an error must not stop the force loop."""

    def suffices(self, share: float, so_far: Callable[[], Grasp]) -> bool:
        """Return whether the evidence suffices at a share of the ramp's force, for the first time.

        ``so_far`` returns the grasp up to now; it is called only at a check.
        """
        if self.answer is not None or not self._shares or share < self._shares[0]:
            return False
        self._shares = [later for later in self._shares if later > share]
        try:
            posterior = self._recognizer.posterior(so_far())
        except RecognitionError:
            # Without a result the ramp continues.
            return False
        except Exception as error:
            self.error = error
            return False
        fused = fuse([*self._earlier, posterior])
        # A drawn size is compared with the most accurate measured one: of a whole ramp.
        if self._rule.suffices(fused) and fused.unknown <= _MOST_UNKNOWN and not posterior.drawn_m:
            self.answer = posterior
        return self.answer is not None


@dataclass(frozen=True, slots=True, kw_only=True)
class Identification:
    """The answer of one grasp-then-classify sequence, with all its grasps.

    It holds all grasps, so it takes megabytes.
    """

    label: str
    """A taught label, or ``UNKNOWN``."""
    decision: Decision
    """Why the sequence ended. Its probability is that of the label, given that the object was
    taught; for ``UNKNOWN`` that of not being the likeliest object. The stop rule uses it."""
    posteriors: tuple[Posterior, ...]
    """Answer to each grasp by itself, in order."""
    fused: Posterior
    """Answer to all grasps together."""
    records: tuple[GraspRecord, ...]
    """The grasps."""
    complaints: tuple[str, ...] = ()
    """Errors of the callback, early checks and shape fits; they do not end the sequence."""
    shapes: tuple[ShapeAnswer | None, ...] = ()
    """Shape and size by each grasp, in order; None if its pads do not show them. Empty if not
    requested."""

    shape: ShapeAnswer | None = None
    """Shape and size by all grasps together."""
    drift: DriftGrid | None = None
    """The sensor drift that the answer assumes; None if drift is not followed."""
    in_grip: bool = False
    """Whether the part stays in the grip."""

    @property
    def n_ended_early(self) -> int:
        """Number of grasps whose ramp ended early because the answer was sure enough."""
        return sum(record.early is not None for record in self.records)


OnGrasp = Callable[[int, GraspRecord, Posterior, ShapeAnswer | None], None]
"""Callback after each grasp: its number from 1, its record, its own answer, and its shape.

An error that it raises does not end the sequence; it is kept in `Identification.complaints`.
"""


_Answer = tuple[Posterior, ShapeAnswer | None, Exception | None]
"""Answer to one grasp: its label, its shape, and the error of the shape fit."""

AnswerExecutor = Callable[[Callable[[], _Answer]], Callable[[], _Answer]]
"""Starts to compute, now or later, and returns the function that waits for the answer."""

CarryOut = Callable[[GraspStep, "Judge"], tuple[GraspRecord, bool]]
"""Carries out one step; the judge's early checks may end its ramp, and it decides about the part.

Returns the record and whether the part was kept.
"""


@dataclass(kw_only=True)
class Judge:
    """Carries a plan out until its answers satisfy the stop rule, and decides about each part."""

    recognizer: Recognizer
    plan: Sequence[GraspStep]
    """Steps in order, at least one."""
    error_rate: float
    """Wanted rate of wrong answers at which the sequence stops early."""
    keep: Keep = Keep.NEVER
    """When the part stays in the grip. A part that may be kept is held while it is classified."""
    regrasps: bool = True
    """False if a part must not be released before the answer: the steps after the first one are
    further ramps in the same grip."""
    early: bool = False
    """Whether each ramp is checked while it runs. With the earlier grasps it may be decided before
    its end; the answer of that moment then counts."""
    read_shape: ReadShape | None = None
    """Reads shape and size of a grasp; see `recognition.recognizer.Posterior.with_size`."""
    on_grasp: OnGrasp | None = None
    compute: AnswerExecutor = lambda answer: answer
    """How answers are computed; by default when the sequence waits for them."""
    posteriors: list[Posterior] = field(default_factory=list)
    records: list[GraspRecord] = field(default_factory=list)
    """Answers to the grasps so far, and their records, in order."""
    early_checks: EarlyDecider | None = None
    """Checks of the present ramp; None without ``early``."""
    decision: Decision = field(init=False)
    """Decision after the grasps so far."""
    _coming: tuple[GraspRecord, Callable[[], _Answer]] = field(init=False)
    _complaints: list[str] = field(default_factory=list)
    _shapes: list[ShapeAnswer | None] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._steps = iter(self.plan)
        self._rule = StopRule(error_rate=self.error_rate, max_grasps=len(self.plan))

    @property
    def keeps(self) -> bool:
        """Whether the part may be kept; it is then measured for a later comparison."""
        return self.keep is not Keep.NEVER

    @property
    def holds(self) -> bool:
        """Whether the part is held until the decision; else it is released before."""
        return self.keeps or not self.regrasps

    @property
    def over(self) -> bool:
        """Whether the sequence needs no further grasp."""
        return self.decision.kind is not DecisionKind.CONTINUE

    def identify(self, grasp: CarryOut) -> Identification:
        """Grasp until the stop rule is satisfied or the plan ends."""
        in_grip = False
        while not (self.records and self.over):
            if self.early:
                self.early_checks = EarlyDecider(self.recognizer, self.posteriors, self._rule)
            _, in_grip = grasp(next(self._steps), self)
            if not self.holds:
                self.add()
            if self.early_checks is not None and self.early_checks.error is not None:
                ramp = f"early checks of the ramp of grasp {len(self.records)}"
                self.complain(ramp, self.early_checks.error)
        shape = self._fused_shape()  # first: it may add a complaint
        return Identification(
            label=self.decision.label,
            decision=self.decision,
            posteriors=tuple(self.posteriors),
            fused=fuse(self.posteriors),
            records=tuple(self.records),
            drift=self._drift(),
            complaints=tuple(self._complaints),
            shapes=tuple(self._shapes),
            shape=shape,
            in_grip=in_grip,
        )

    def _drift(self) -> DriftGrid | None:
        if not isinstance(self.recognizer, DriftFollowing):
            return None
        return self.recognizer.grid.at(self.records[-1].grasp.start_ms)

    def decide(self) -> GraspStep | None:
        """Wait for the answer, while the part is held; return the step of a further ramp, or None.

        The force of the step is the end of the ramp in the same grip.
        """
        self.add()
        return None if self.over or self.regrasps else next(self._steps)

    @property
    def keeps_part(self) -> bool:
        """Whether the part stays in the grip for the host."""
        return self.over and self.keep.keeps(self.decision.label)

    def start_answer(self, record: GraspRecord) -> None:
        """Begin to compute the answer to a grasp at the end of its ramp; `add` follows.

        If the force loop has its own process, it is computed during the motion that follows.
        """
        self._coming = record, self.compute(lambda: self._answer(record))

    def _answer(self, record: GraspRecord) -> _Answer:
        """Return the answer to a grasp; may run on its own thread."""
        posterior = record.early or self.recognizer.posterior(record.grasp)
        try:
            # Closed fingers press a small part deeper than the fit can follow.
            read = None if record.outcome.unreached else self.read_shape
            shape = None if read is None else read(record.grasp)
        except Exception as error:
            return posterior, None, error
        return posterior, shape, None

    def add(self) -> None:
        """Wait for the started answer and add it."""
        record, answer = self._coming
        posterior, shape, error = answer()
        if record.same_grip:
            dependence = max(posterior.dependence, SAME_GRIP_DEPENDENCE)
            posterior = replace(posterior, dependence=dependence)
        self.records.append(record)
        number = len(self.records)
        if error is not None:
            self.complain(f"shape of grasp {number}", error)
        if self.read_shape is not None:
            self._shapes.append(shape)
        if shape is not None:
            posterior = posterior.with_size(shape.low_m, shape.high_m)
        self.posteriors.append(posterior)
        if self.on_grasp is not None:
            try:
                self.on_grasp(number, record, posterior, shape)
            except Exception as error:
                self.complain(f"after grasp {number}", error)
        self.decision = decide(self.posteriors, self._rule)

    def complain(self, when: str, error: Exception) -> None:
        """Keep an error without ending the sequence."""
        self._complaints.append(f"{when}: {error_text(error)}")

    def _fused_shape(self) -> ShapeAnswer | None:
        """Return shape and size by all grasps; an error becomes a complaint, the label stays."""
        read = [shape for shape in self._shapes if shape is not None]
        try:
            return fuse_shapes(read) if read else None
        except Exception as error:
            self.complain("shape of all grasps", error)
            return None
