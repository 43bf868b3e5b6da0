"""Archive recordings, train and evaluate on a Dask cluster, whose workers may be other machines.

python train_on_a_cluster.py tcp://HOST:8786 RECORDINGS ARCHIVE MODEL
"""

import sys
from functools import partial
from pathlib import Path

from distributed import Client

from cell.archive.ingest import ingest, sources
from cell.archive.store import Archive
from cell.evaluation import evaluate_recognizers
from cell.learning.model import save_model
from cell.learning.training import train

NAMES = ("level_check", "force_ramp")


def trained(archive, name):  # on a worker, which reads the archive itself
    return train(list(Archive(archive).grasps(most=400)), name)


def main(scheduler, recordings, archive, model):
    with Client(scheduler, timeout=15) as client:

        def spread(work, items):
            for future in client.map(work, items, pure=False):
                yield future.result()

        def quiet(*_progress):
            pass

        done = ingest(archive, sources([Path(recordings)]), mapper=spread, progress=quiet)
        print(f"{done.n_grasps} grasps of {done.n_files} files, {len(done.left)} files left")
        models = dict(zip(NAMES, spread(partial(trained, archive), NAMES), strict=True))
        grasps = list(Archive(archive).grasps(most=400))
        results = evaluate_recognizers(
            grasps, split="days", names=NAMES, mapper=spread, progress=quiet
        )
        right = {name: one.full.named_right for name, one in results.recognizers.items()}
        for name, share in right.items():
            print(f"{name}: {share:.1%} of the grasps of new days named rightly")
        best = max(right, key=right.__getitem__)
        save_model(Path(model), models[best], grasps)
        print(f"{best}: {model}")


if __name__ == "__main__":
    main(*sys.argv[1:])
