"""Knobs of what the lamps, the day and the vehicle's own lamp shine on: solids, their finish, and ready-made docks."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, model_validator

from lumidock.sim.knobs import Counts, Lengths, Place, Probability, Section, Sizes

Reflectances = tuple[Probability, Probability, Probability]
Small = Annotated[float, Field(gt=0.0, le=1000.0)]
Period = Annotated[float, Field(ge=1e-3, le=100.0)]


class Finish(Section):
    """How a surface reflects, at 455, 530 and 610 nm."""

    albedo: Reflectances = (0.5, 0.5, 0.5)  # diffuse reflectance
    gloss: Probability = 0.0  # share of head-on light in the glossy lobe; wet paint about 0.02, metal 0.3-0.6
    shininess: Annotated[float, Field(ge=1.0, le=1e5)] = 50.0  # exponent of that lobe: satin 20, polished 1000
    pattern: Literal["plain", "tiles", "sectors", "stripes"] = "plain"
    second: Reflectances = (0.1, 0.1, 0.1)  # albedo of joints, dark sectors or stripes
    period: Period = 0.2  # m between joints or stripes, rad between sectors
    share: Probability = 0.05  # of a period that is joint, dark sector or stripe
    mottle: Probability = 0.0  # relative depth of stains
    mottle_m: Small = 0.5  # and their largest size

    @model_validator(mode="after")
    def _no_more_light_than_comes(self) -> Self:
        if max(*self.albedo, *self.second) + self.gloss > 1.0:
            raise ValueError("wanted albedo and gloss that add up to no more than 1")
        return self


# Reflectances: white paint 0.8, concrete 0.2-0.4, oxidised steel 0.1-0.2, black plastic 0.03-0.05 (CRC Handbook of
# Chemistry and Physics, emissivity and albedo tables); glazed tile and wet paint reflect 2 % at an interface with water
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


class Solid(Section):
    """One solid in the frame of the dock, or of the camera.

    A box has its `center`, `half_m` and is turned so that its local z is `axis`; a tube or cone runs from `center`
    to `end`, with `radius_m` at both; a ring lies around `center` across `axis`, between the two of `radius_m`; an
    ellipsoid has `half_m` as its semi-axes.
    """

    kind: Literal["box", "tube", "ring", "ellipsoid"]
    frame: Literal["dock", "cam"] = "dock"
    finish: str = "grey"
    center: Place = (0.0, 0.0, 0.0)
    end: Place = (0.0, 0.0, -1.0)
    axis: Place = (0.0, 0.0, 1.0)
    half_m: tuple[Small, Small, Small] = (0.1, 0.1, 0.1)
    radius_m: tuple[NonNegativeFloat, NonNegativeFloat] = (0.02, 0.02)

    @model_validator(mode="after")
    def _has_an_extent(self) -> Self:
        if self.kind == "tube" and self.center == self.end:
            raise ValueError("wanted an end that is not the center")
        if max(map(abs, self.axis)) == 0.0:
            raise ValueError("axis has no direction")
        if self.kind in ("tube", "ring") and max(self.radius_m) == 0.0:
            raise ValueError("radius_m: wanted one over 0")
        return self


class Basin(Section):
    """Walls and floor around the dock; a wall at 0 is left out."""

    back_m: NonNegativeFloat = 3.0  # of the wall behind the dock, from its origin
    side_m: NonNegativeFloat = 4.0  # of the walls left and right
    floor_m: NonNegativeFloat = 2.5  # below the dock's origin
    wall: str = "tiles"  # finishes
    floor: str = "tiles"


class Jellyfish(Section):
    """Pale bodies that drift before the camera."""

    count: Counts = (4, 4)
    radius_m: Sizes = (0.05, 0.15)
    distance_m: Sizes = (1.5, 6.0)  # from the camera
    speed_m_s: Lengths = (0.02, 0.1)


class Matter(Section):
    """Solid things in view; none of them by default."""

    dock: Literal["none", "cage", "funnel", "plate"] = "none"
    basin: Basin | None = None
    ropes: bool = False  # that hold the dock from above
    hull: bool = False  # the own vehicle's yellow nose below the camera
    jellyfish: Jellyfish | None = None
    solids: tuple[Solid, ...] = ()
    finishes: dict[str, Finish] = Field(default_factory=dict)  # by name, in place of the known ones or beside them

    @property
    def is_any(self) -> bool:
        """Whether there is anything to draw."""
        return bool(self.dock != "none" or self.basin or self.ropes or self.hull or self.jellyfish or self.solids)

    def finish(self, name: str) -> Finish:
        """The finish of a name."""
        return self.finishes.get(name) or FINISHES[name]

    @model_validator(mode="after")
    def _finishes_are_known(self) -> Self:
        basin = [self.basin.wall, self.basin.floor] if self.basin else []
        for name in [*(solid.finish for solid in self.solids), *basin]:
            if name not in self.finishes and name not in FINISHES:
                raise ValueError(f"no finish {name}; there are {', '.join([*FINISHES, *self.finishes])}")
        return self
