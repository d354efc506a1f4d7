"""Other people's methods, written anew from their papers, on the same detections and behind the same two entries."""

from lumidock.baselines import cpd, hungarian, learned, neighbours, plain_pso, ransac, vote
from lumidock.baselines.localizer import BaselineLocalizer
from lumidock.baselines.view import Associate

ASSOCIATIONS: dict[str, Associate] = {
    "hungarian": hungarian.associate,
    "plain-pso": plain_pso.associate,
    "p3p-vote": vote.associate,
    "p3p-neighbours": neighbours.associate,
    "ransac-p3p": ransac.associate,
    "cpd": cpd.associate,
    "learned": learned.associate,
}

__all__ = ["ASSOCIATIONS", "BaselineLocalizer"]
