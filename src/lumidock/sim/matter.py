"""Settings of the solid bodies in a scenario: docks, walls, ropes, hull, jellyfish, and how their surfaces reflect."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, model_validator
from typing_extensions import Self

from lumidock.sim.knobs import Counts, KnobSection, Lengths, Place, Probability, Sizes

Reflectances = tuple[Probability, Probability, Probability]
WallDistance = Annotated[float, Field(ge=0.0, le=900.0)]
Extent = Annotated[float, Field(gt=0.0, le=1000.0)]
Period = Annotated[float, Field(ge=1e-3, le=100.0)]


class Finish(KnobSection):
    """How a surface reflects; three values are those at 455, 530 and 610 nm."""

    albedo: Reflectances = (0.5, 0.5, 0.5)  # diffuse reflectance
    gloss: Probability = 0.0  # glossy reflectance head-on; wet paint about 0.02, metal 0.3-0.6
    shininess: Annotated[float, Field(ge=1.0, le=1e5)] = 50.0  # exponent of the glossy lobe: satin 20, polished 1000
    pattern: Literal["plain", "tiles", "sectors", "stripes"] = "plain"
    second: Reflectances = (0.1, 0.1, 0.1)  # albedo of the pattern's joints, sectors or stripes
    period: Period = 0.2  # of the pattern: m for tiles and stripes, rad for sectors
    share: Probability = 0.05  # share of a period that has the albedo `second`
    mottle: Probability = 0.0  # relative change of the albedo by stains
    mottle_m: Extent = 0.5  # size of the largest stains, m

    @model_validator(mode="after")
    def _reflects_no_more_than_it_receives(self) -> Self:
        if max(*self.albedo, *self.second) + self.gloss > 1.0:
            raise ValueError("albedo and gloss have to add up to no more than 1")
        return self


# Diffuse reflectances: white paint 0.8, concrete 0.2-0.4, oxidised steel 0.1-0.2, black plastic 0.03-0.05 (CRC Handbook
# of Chemistry and Physics, tables of emissivity and albedo). Under water, tiles and wet paint reflect 2 % head-on.
FINISHES = {
    "white": Finish(albedo=(0.75, 0.78, 0.78), gloss=0.03, shininess=60.0),
    "grey": Finish(albedo=(0.35, 0.36, 0.36), gloss=0.03, shininess=40.0),
    "black": Finish(albedo=(0.03, 0.03, 0.03), gloss=0.02, shininess=40.0),
    "metal": Finish(albedo=(0.28, 0.30, 0.31), gloss=0.35, shininess=200.0),
    "yellow": Finish(albedo=(0.06, 0.50, 0.65), gloss=0.03, shininess=150.0),
    "rope": Finish(albedo=(0.40, 0.45, 0.48), mottle=0.2, mottle_m=0.1),
    "funnel": Finish(
        albedo=(0.75, 0.78, 0.78),
        gloss=0.03,
        shininess=60.0,
        pattern="sectors",
        period=1.5708,
        share=0.12,
        second=(0.04, 0.04, 0.04),
    ),
    "tiles": Finish(
        albedo=(0.55, 0.62, 0.58),
        gloss=0.02,
        shininess=200.0,
        pattern="tiles",
        period=0.2,
        share=0.05,
        second=(0.2, 0.22, 0.2),
        mottle=0.15,
        mottle_m=0.9,
    ),
    "concrete": Finish(albedo=(0.05, 0.14, 0.18), mottle=0.6, mottle_m=0.9),
    "silt": Finish(albedo=(0.03, 0.05, 0.06), mottle=0.5, mottle_m=1.2),
    "jelly": Finish(albedo=(0.20, 0.22, 0.24), gloss=0.02, shininess=200.0, pattern="sectors", period=0.4, share=0.3,
                    second=(0.12, 0.12, 0.14)),
}  # fmt: skip


class Solid(KnobSection):
    """One solid, given in the frame `dock` or `cam`, in metres.

    box: half lengths `half_m` around `center`; its local z axis is `axis`. tube: a cylinder or cone without end caps
    from `center` to `end`, with the two radii `radius_m` there. ring: flat, around `center` and normal to `axis`, with
    inner and outer radius `radius_m`. ellipsoid: semi-axes `half_m` around `center`.
    """

    kind: Literal["box", "tube", "ring", "ellipsoid"]
    frame: Literal["dock", "cam"] = "dock"
    finish: str = "grey"
    center: Place = (0.0, 0.0, 0.0)
    end: Place = (0.0, 0.0, -1.0)
    axis: Place = (0.0, 0.0, 1.0)
    half_m: tuple[Extent, Extent, Extent] = (0.1, 0.1, 0.1)
    radius_m: tuple[NonNegativeFloat, NonNegativeFloat] = (0.02, 0.02)

    @model_validator(mode="after")
    def _has_an_extent(self) -> Self:
        if self.kind == "tube" and self.center == self.end:
            raise ValueError("end: has to differ from center")
        if max(map(abs, self.axis)) == 0.0:
            raise ValueError("axis: has to differ from zero")
        if self.kind in ("tube", "ring") and max(self.radius_m) == 0.0:
            raise ValueError("radius_m: one of the two has to be over 0")
        return self


class Basin(KnobSection):
    """Walls and floor of a pool or a channel around the dock; a distance of 0 leaves out the wall or the floor."""

    back_m: WallDistance = 3.0  # from the dock's origin back to the wall behind it
    side_m: WallDistance = 4.0  # from the dock's origin to the walls left and right
    floor_m: WallDistance = 2.5  # from the dock's origin down to the floor
    wall: str = "tiles"  # name of a finish
    floor: str = "tiles"  # name of a finish


class Jellyfish(KnobSection):
    """Jellyfish: pale, opaque ellipsoids that drift in front of the camera."""

    count: Counts = (4, 4)  # drawn once a run
    radius_m: Sizes = (0.05, 0.15)
    distance_m: Sizes = (1.5, 6.0)  # from the camera
    speed_m_s: Lengths = (0.02, 0.1)


class Matter(KnobSection):
    """The solid bodies in view; there are none by default."""

    dock: Literal["none", "cage", "funnel", "plate"] = "none"  # a body built around the lights of the station
    basin: Basin | None = None
    ropes: bool = False  # two ropes that hold the dock from above
    hull: bool = False  # the own vehicle's yellow nose, below the camera
    jellyfish: Jellyfish | None = None
    solids: tuple[Solid, ...] = ()
    finishes: dict[str, Finish] = Field(default_factory=dict)  # by name; they replace shipped ones

    @property
    def is_present(self) -> bool:
        """Whether there is any solid to draw."""
        return bool(self.dock != "none" or self.basin or self.ropes or self.hull or self.jellyfish or self.solids)

    def finish(self, name: str) -> Finish:
        """The finish with this name, from the scenario or among those that are shipped."""
        return self.finishes.get(name) or FINISHES[name]

    @model_validator(mode="after")
    def _finishes_are_known(self) -> Self:
        basin = [self.basin.wall, self.basin.floor] if self.basin else []
        for name in [*(solid.finish for solid in self.solids), *basin]:
            if name not in self.finishes and name not in FINISHES:
                raise ValueError(f"{name}: no such finish; there are {', '.join([*FINISHES, *self.finishes])}")
        return self
