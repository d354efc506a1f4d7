"""A small campaign: both methods on lights missing and spurious ones, without history.

python examples/06_campaign.py FOLDER
"""

import sys
from pathlib import Path

import lumidock
from lumidock.evaluation.campaign import plan, prepare, run_campaign, tabulate
from lumidock.evaluation.campaign_table import markdown
from lumidock.sim.scenario import load_scenario

PACKAGE = Path(lumidock.__file__).parent

if __name__ == "__main__":  # workers import this file
    out = Path(sys.argv[1])
    campaign = plan(
        [load_scenario(name, ("path.count=50",)) for name in ("missing-1", "missing-spurious")],
        ["lumidock", "paper"],
        (0, 1),
        PACKAGE / "stations" / "cage-2x2x5.yaml",
        PACKAGE / "cameras" / "imx264-60deg.yaml",
        cold=True,
    )
    prepare(campaign, out)
    run_campaign(campaign, out, workers=0)  # 0: in this process
    print(markdown(tabulate(campaign, out)))
