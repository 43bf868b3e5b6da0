from .grasp import Grasp as Grasp, GraspCommand as GraspCommand, PadArray as PadArray
from .recognizer import (
    UNKNOWN as UNKNOWN,
    Posterior as Posterior,
    Recognizer as Recognizer,
    Trainer as Trainer,
)
from .recognizers import make_trainer as make_trainer, trainer_names as trainer_names
from .statistics.fusion import (
    Decision as Decision,
    StopRule as StopRule,
    decide as decide,
    fuse as fuse,
)
