"""Read a run folder: how often there was an answer, and how good it says that it is.

python examples/05_read_a_run.py RUN
"""

import sys
from pathlib import Path

import numpy as np

from lumidock import load_station
from lumidock.streams.replay import read_fixes

if len(sys.argv) != 2:
    sys.exit(__doc__)
run = Path(sys.argv[1])
fixes = [fix for fix, _, _ in read_fixes(run, load_station(run / "station.yaml").ids)]
valid = [fix for fix in fixes if fix.valid]
print(
    f"{len(valid)} of {len(fixes)} frames have a pose, {sum(fix.guide is not None for fix in fixes)} bearing and range"
)
for stage in ("front", "transition", "rear"):
    sigma = [np.sqrt(np.trace(fix.covariance[:3, :3])) for fix in valid if fix.stage == stage]
    if sigma:
        print(f"{stage:10}  {len(sigma):4} poses, position good to {np.median(sigma):.3f} m (1 sigma, median)")
