"""What the COLMAP process is told, and its limits."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Job:
    """What is to be posed, how, and where the process keeps what a killed run leaves to the next."""

    photos: str
    """Folder of the working copies."""
    masks: str
    """Folder of masks, NAME.jpg.png for NAME.jpg, black where features do not count; empty where there is none."""
    scratch: str
    """Folder for databases and models; what lies there from a run of the same job is used."""
    thorough: bool
    """Whether to find more features, and to match them with a wider limit."""
    groups: list[list[str]]
    """File names of the photos that share a camera."""
    exhaustive: bool
    """Whether all pairs of photos are compared, or neighbours in name order."""
    threads: int
    """CPU threads."""
    seed: int
    """For the random choices of matching and mapping."""

    @property
    def names(self) -> list[str]:
        """File names of all photos, sorted."""
        return sorted(name for group in self.groups for name in group)

    @property
    def folder(self) -> Path:
        """`scratch` as a path."""
        return Path(self.scratch)

    @property
    def output(self) -> Path:
        """The file for the best model."""
        return self.folder / "best.json"


@dataclass(frozen=True)
class Search:
    """What pairs are compared, and when the search for a model ends."""

    preselect_above: int = 24
    """Photos; up to this many, all pairs are compared with all features."""
    preselect_features: int = 1000
    """Largest features of a photo by which its partners are found (preemptive matching: Wu 2013, section 3)."""
    preselect_partners: int = 8
    """A photo with fewer partners than this is compared with all others."""
    min_track: int = 3
    """Photos that must see a point for it to count; two photos make a point of any false match."""
    max_error_px: float = 1.5
    """Largest mean reprojection error of a point that counts."""
    min_observations: int = 30
    """Points that a photo must see for its pose to count (COLMAP: abs_pose_min_num_inliers)."""
    enough_photos: float = 0.9
    """A model with this share of all photos, and with all that have matches, may end the search."""
    clear_explained: float = 0.5
    """It ends the search where it explains this share of all verified matches."""
    focal_range: tuple[float, float] = (0.35, 5.0)
    """Focal lengths, in longest sides of the photo, that are believed of the view graph's calibration."""
    same_focal: float = 0.03
    """A second start that is closer to the first than this share gives the same model."""
    poor_share: float = 0.8
    """A photo with less than this of the median photo's share of matches explained is posed anew."""
    lens_observations: int = 300
    """Points that the photos of one camera must see for its whole lens to be solved: 30 for each of its numbers."""
    lens_rounds: int = 3
    """How often a lens is solved, each time with the matches that the last one explains."""
    lens_error: float = 0.9
    """Share to which the mean reprojection error of these photos must fall for their lenses to be taken."""
    alike: float = 0.99
    """Models whose score is above this share of the best one's are compared by their reprojection errors."""
    adjustments: int = 5
    """The most bundle adjustments in a row, each followed by dropping outliers (COLMAP: ba_global_max_refinements)."""
    adjusted_change: float = 0.0005
    """Share of observations that changed below which they end (COLMAP: ba_global_max_refinement_change)."""


SEARCH = Search()
