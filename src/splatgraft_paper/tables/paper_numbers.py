"""Numbers of the paper's tables, transcribed from its source, for comparison with ours."""

from collections.abc import Mapping
from dataclasses import dataclass

_FIVE = ("psnr", "ssim", "lpips", "fid", "kid")


@dataclass(frozen=True)
class PublishedTable:
    """One table of the paper."""

    key: str
    """Short name, such as "synthetic"."""
    title: str
    """Title with the table's number in the paper."""
    columns: tuple[str, ...]
    """Metrics in the order of the table."""
    rows: Mapping[str, tuple[float, ...]]
    """Numbers by the paper's name of the row."""

    def value(self, row: str, column: str) -> float | None:
        """Return a published number, or None if the table has none."""
        numbers = self.rows.get(row)
        return None if numbers is None or column not in self.columns else numbers[self.columns.index(column)]


SYNTHETIC = PublishedTable(
    "synthetic",
    "Quantitative 3D evaluation: nine synthetic scenes (the paper's Table 1)",
    _FIVE,
    {
        "Ours": (22.53, 0.840, 0.214, 55.86, 0.0413),
        "GShader": (18.66, 0.799, 0.272, 152.62, 0.1742),
        "GS-IR": (17.83, 0.803, 0.247, 110.96, 0.1143),
        "3DGS-DR": (19.65, 0.814, 0.245, 124.07, 0.1448),
    },
)
ROTATION = PublishedTable(
    "rotation",
    "Illumination consistency: three scenes, the object at three rotations (the paper's Table 2)",
    _FIVE,
    {
        "P0": (25.14, 0.9135, 0.1553, 46.41, 0.0161),
        "P1": (24.85, 0.9117, 0.1589, 38.34, 0.0118),
        "P2": (24.16, 0.9097, 0.1639, 45.78, 0.0160),
    },
)
UPDATES = PublishedTable(
    "updates",
    "Iterative dataset update against one consolidation (the paper's Table 4)",
    ("minutes", *_FIVE),
    {
        "Ours": (15.5, 22.53, 0.840, 0.214, 55.86, 0.0413),
        "w/Linear": (68.0, 21.79, 0.826, 0.225, 59.46, 0.0462),
        "w/Geometric": (68.0, 21.55, 0.820, 0.230, 60.47, 0.0477),
    },
)

DATA = PublishedTable(
    "data",
    "Dataset ablation: the harmoniser trained without one source, on the test split of each (the paper's Table 3)",
    tuple(f"{metric} {source}" for source in ("Blender", "FLUX", "ORIDa", "Average") for metric in _FIVE[:4]),
    {
        "Ours": (27.08, 0.893, 0.124, 33.86, 28.34, 0.892, 0.108, 25.13,
                 30.08, 0.865, 0.170, 74.64, 28.50, 0.883, 0.134, 44.54),
        "w/o Blender": (25.69, 0.870, 0.164, 47.78, 28.28, 0.890, 0.106, 26.90,
                        29.71, 0.863, 0.160, 86.49, 27.89, 0.874, 0.143, 53.72),
        "w/o Flux": (26.98, 0.895, 0.122, 34.64, 24.70, 0.852, 0.147, 46.23,
                     30.41, 0.868, 0.163, 70.19, 27.36, 0.872, 0.144, 50.36),
        "w/o Orida": (26.93, 0.890, 0.130, 35.93, 28.29, 0.892, 0.104, 24.66,
                      29.92, 0.887, 0.126, 73.46, 28.38, 0.890, 0.120, 44.68),
    },
)  # fmt: skip
COST = PublishedTable(
    "cost",
    "Computational cost of a scene with 200 views of 704x496 (the paper's Sec. 7.3; an H100)",
    ("minutes",),
    {
        "reconstruct, each scene": (2.5,),
        "segment": (40 / 60,),
        "harmonize": (12.5,),
        "consolidate, LPIPS": (3.0,),
        "consolidate, L1 and SSIM": (1.0,),
    },
)

SCENES = {
    "synthetic": 9,
    "real": 7,
    "rotation": 9,
}
"""Number of scenes of each kind in the published data set; a rotation counts as a scene."""
LISTED = {
    "synthetic": (
        "bathtub_57e_in_blend_57eadb", "bed_bg3_in_blend_adfc14", "carriage_in_blend_85a1a6",
        "helicopter_in_blend_808c29", "sink_in_blend_92e6c7",
    ),
    "real": (
        "desk_in_london_bedroom", "locomotive_in_train", "plant_in_bouquet", "sedan_in_c0e46b", "truck_in_garden",
        "508850_in_4cea29", "d11d95_in_83d5f2",
    ),
}  # fmt: skip
"""Names of scenes in the data set's card, as far as they are known: five of nine synthetic ones, all real ones."""


def published_name(method: str) -> str:
    """Look up the paper's name of a method by the name of its folder; other names are returned unchanged."""
    plain = "".join(letter for letter in method.lower() if letter.isalnum())
    return _NAMES.get(plain, method)


_NAMES = {
    **dict.fromkeys(("ours", "dot3d", "our", "oursfinal"), "Ours"),
    **dict.fromkeys(("gshader", "gaussianshader", "gsshader"), "GShader"),
    "gsir": "GS-IR",
    **dict.fromkeys(("3dgsdr", "gsdr"), "3DGS-DR"),
    "paper": "Ours",
    **dict.fromkeys(("withoutblender", "woblender"), "w/o Blender"),
    **dict.fromkeys(("withoutflux", "woflux"), "w/o Flux"),
    **dict.fromkeys(("withoutorida", "woorida"), "w/o Orida"),
    **dict.fromkeys(("composite", "composites", "naive", "copypaste"), "Composite"),
    **dict.fromkeys(("linear", "wlinear", "ourslinear", "iterativelinear"), "w/Linear"),
    **dict.fromkeys(("geometric", "wgeometric", "oursgeometric", "iterativegeometric"), "w/Geometric"),
}
