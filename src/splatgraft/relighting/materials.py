"""Gloss of an object's materials, fitted to its views under the old light and shown under the new light.

1. Cluster the Gaussians by colour and place (`_clusters`).
2. Fit one reflection lobe to each cluster by least squares: the view-dependent part of its colours is a reflectance
   times the light in mirrored directions (`_fitted`). The rest of the colours is matt.
3. Project the lobes under the new light to harmonics (`gloss_bands`).

Lobes are von Mises-Fisher densities (reflection as convolution, Ramamoorthi and Hanrahan 2001). The convolution of a
lobe with a light sample adds variances; with the ambient harmonics it multiplies them by the lobe's coefficients.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians, KnownSurface
from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.core.k_means import k_means
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.samples import LightSamples
from splatgraft.relighting.object_views import ObjectView
from splatgraft.relighting.shading import apply_gain


@dataclass(frozen=True)
class ReflectedLight:
    """A light at n surface points, in the form that reflections need."""

    directions: Float[Tensor, "k 3"]
    """Unit, towards the k samples of its sources."""
    irradiance: Float[Tensor, "k 3"]
    """Linear rgb of each sample."""
    softness: Float[Tensor, "k"]
    """Radius of each sample's cone, radians."""
    visibility: Float[Tensor, "n k"]
    """Share of each sample that reaches each point, in [0, 1]."""
    ambient: Float[Tensor, "9 3"]
    """Radiance of all other light, harmonics of degree 2."""

    def select(self, rows: slice | Int[Tensor, "m"]) -> "ReflectedLight":
        """Select the light at m of the points."""
        return replace(self, visibility=self.visibility[rows])

    def scaled(self, factor: Float[Tensor, "3"]) -> "ReflectedLight":
        """Multiply every channel of the light by a factor."""
        return replace(self, irradiance=self.irradiance * factor, ambient=self.ambient * factor)

    def windowed(self) -> "ReflectedLight":
        """Multiply the ambient harmonics by Lanczos' factors, so that their series does not ring (Sloan 2008)."""
        factors = torch.sinc(torch.tensor([0.0] + [1.0] * 3 + [2.0] * 5) / 3)
        return replace(self, ambient=factors[:, None] * self.ambient)

    def radiance(self, directions: Float[Tensor, "n v 3"], concentration: float) -> Float[Tensor, "n v 3"]:
        """Average linear rgb radiance at n points over lobes around v directions each.

        Args:
            directions: Unit, away from the surface.
            concentration: Concentration of the lobes: one over the square of their width in radians.
        """
        total = self.ambient_radiance(directions, concentration)
        for i in range(len(self.directions)):
            # variances per axis add: r^2 / 4 for a cone of radius r, and 1 / concentration for a lobe
            k = 1 / (1 / concentration + 0.25 * float(self.softness[i]) ** 2)
            peak = k / (2 * math.pi * (1 - math.exp(-2 * k)))
            lobe = peak * torch.exp(k * (directions @ self.directions[i] - 1)) * self.visibility[:, i : i + 1]
            total = total + lobe[..., None] * self.irradiance[i]
        return total

    def ambient_radiance(self, directions: Float[Tensor, "n v 3"], concentration: float) -> Float[Tensor, "n v 3"]:
        """Average the ambient light's linear rgb radiance over lobes, as `radiance` does for all light."""
        first = 1 / math.tanh(concentration) - 1 / concentration
        bands = torch.tensor([1.0] + [first] * 3 + [1 - 3 * first / concentration] * 5)
        return (spherical_harmonics.basis(directions, 2) @ (bands[:, None] * self.ambient)).clamp_min(0)

    def microfacet_radiance(
        self, views: Float[Tensor, "n v 3"], normals: Float[Tensor, "n 3"], materials: "Materials"
    ) -> Float[Tensor, "n v 3"]:
        """Compute the linear rgb that n GGX surfaces reflect in v views by the sources (Walter et al. 2007).

        Light that the surface masks leaves after further reflections (Turquin 2019).

        Args:
            views: Unit, from the cameras to points in front of the surfaces.
            normals: Unit, outward.
            materials: Materials of the n surfaces, with `roughness`.
        """
        assert materials.roughness is not None
        facing = -(views * normals[:, None]).sum(-1)
        roughness = materials.roughness.clamp_min(_SMOOTHEST)
        total = torch.zeros(views.shape)
        for i in range(len(self.directions)):
            towards = self.directions[i]
            half = torch.nn.functional.normalize(towards - views, dim=-1)
            # a cone of radius r adds the variance r^2 / 4 per axis to the lobe's 2 alpha^2
            square = (roughness**4 + float(self.softness[i]) ** 2 / 8)[:, None]
            cosine, incident = (half * normals[:, None]).sum(-1), (normals @ towards)[:, None].clamp_min(0)
            density = square / (math.pi * (1 + (square - 1) * cosine**2) ** 2)
            # Smith's masking of view and light over 4 cosines, times the cosine of incidence
            from_view, from_light = (x + (square + (1 - square) * x**2).sqrt() for x in (facing, incident))
            factor = density * incident / (from_view * from_light) * materials.fresnel(half @ towards)
            total = total + (factor * self.visibility[:, i : i + 1])[..., None] * self.irradiance[i]
        reflected = (1 - _MASKED * roughness**3)[:, None]
        return total * (materials.reflectance * (1 + materials.reflectance * (1 / reflected - 1)))[:, None]


def reflected_light(light: Light, samples: LightSamples, visibility: Float[Tensor, "n k"]) -> ReflectedLight:
    """Convert a light to the form that reflections at n points need.

    Args:
        light: The light.
        samples: The k samples of that light.
        visibility: Share of each sample that reaches each point, in [0, 1].
    """
    sources = samples.of_sources
    unsure = sum((torch.tensor(s.irradiance) * (1 - s.confidence) for s in light.sources), torch.zeros(3))
    ambient = light.ambient.clone()
    ambient[0] += unsure / (4 * math.pi * spherical_harmonics.C0)
    return ReflectedLight(
        directions=sources.directions,
        irradiance=sources.irradiance,
        softness=sources.softness,
        visibility=visibility[:, : len(sources)],
        ambient=ambient,
    )


_CHUNK = 8192  # Gaussians at a time; bounds memory
_MAX_FITTED = 8192  # Gaussians that lobes are fitted to, spread over the object; more add time and change nothing

# the model; on twelve rendered scenes with true lights the result is flat around all of these
_CLUSTERS = 6  # clusters of colour and place; 2 to 16 give the same PSNR within 0.02 dB
_CONCENTRATIONS = (1.5, 3.0, 6.0, 12.0, 25.0)  # lobes from satin to polished; bands of degree 3 hold no finer ones
_EVIDENCE = 0.05  # explained share of pure noise; a lobe that explains as much keeps half of its reflectance
_LOWEST_COSINE = 0.1  # between normal and view; flatter views are left out
_MIN_MATT = 0.2  # smallest matt share of a Gaussian's colour
_SMOOTHEST = 0.05  # perceptual roughness; smoother surfaces are blurred to this one
_MASKED = math.log(2)  # share of light that GGX of roughness 1 masks at normal incidence; about times roughness^3
_FACING = 0.04  # reflectance of a dielectric at normal incidence over grazing incidence (Schlick 1994)


@dataclass(frozen=True)
class Materials:
    """One reflection lobe for each of n Gaussians, and their matt colours."""

    reflectance: Float[Tensor, "n 3"]
    """Reflected share of the light in the lobe, linear rgb, at least 0; 0 without evidence of gloss."""
    concentration: Float[Tensor, "n"]
    """Concentration of the lobe."""
    dielectric: Bool[Tensor, "n"]
    """Whether reflectance grows towards grazing views (Schlick 1994); otherwise it is constant, as for a metal."""
    matt: Float[Tensor, "n 3"]
    """Linear rgb under the old light, without the lobe."""
    share: Float[Tensor, "n"]
    """Share of the lobe in the colour under the old light, in [0, 1]."""
    emission: Float[Tensor, "n 3"]
    """Emitted linear rgb."""
    facing: Float[Tensor, "n"] | None = None
    """Share of a dielectric's reflectance at normal incidence; None for `_FACING`."""
    roughness: Float[Tensor, "n"] | None = None
    """Perceptual roughness of GGX surfaces, which reflect sources; None for lobes that were fitted to views."""

    def select(self, rows: slice | Int[Tensor, "m"]) -> "Materials":
        """Select the materials of m Gaussians."""
        return Materials(**{name: values[rows] for name, values in vars(self).items() if values is not None})

    def fresnel(self, cosine: Float[Tensor, "n v"]) -> Float[Tensor, "n v"]:
        """Compute factors on the reflectance for v cosines of incidence (Schlick 1994); 1 for metals."""
        facing = _FACING if self.facing is None else self.facing[:, None]
        return torch.where(self.dielectric[:, None], _schlick(cosine, facing), torch.ones(()))

    @property
    def glossy(self) -> Bool[Tensor, "n"]:
        """Whether each Gaussian has a lobe, or emits light."""
        return (self.reflectance > 0).any(1) | (self.emission > 0).any(1)

    @property
    def mirrors(self) -> Bool[Tensor, "n"]:
        """Whether each Gaussian is a mirror, with reflections too sharp for its bands."""
        sharpest = self.concentration >= max(_CONCENTRATIONS)
        return sharpest & ~self.dielectric & (self.reflectance.mean(1) > 0.3)


def known_materials(surface: KnownSurface) -> Materials:
    """Represent metallic-roughness materials by GGX for sources, and by lobes for ambient light.

    The concentration of a GGX lobe around the mirrored direction is 1 / (2 alpha^2) (Wang et al. 2009). A rough
    dielectric reflects less towards grazing views (Lagarde 2011). The matt part has factor 1 - mean reflectance.
    """
    albedo = linear_from_srgb(spherical_harmonics.rgb_from_dc(surface.sh[:, 0]).clamp(0, 1))
    metal = surface.metallic[:, None]
    grazing = (1 - surface.roughness).clamp_min(_FACING)
    mean = _FACING + (grazing - _FACING)[:, None] / 21  # integral of Schlick's approximation over the hemisphere
    sharpness = -math.log(2) - 4 * surface.roughness.clamp_min(_SMOOTHEST).log()
    lobes = torch.tensor(_CONCENTRATIONS)
    return Materials(
        reflectance=torch.where(metal > 0.5, metal * albedo + _FACING * (1 - metal), grazing[:, None]),
        concentration=lobes[(sharpness[:, None] - lobes.log()).abs().argmin(1)],
        dielectric=surface.metallic <= 0.5,
        matt=(1 - metal) * (1 - mean) * albedo,
        share=torch.zeros(surface.count),
        emission=surface.emission,
        facing=_FACING / grazing,
        roughness=surface.roughness,
    )


def estimate_materials(
    gaussians: Gaussians, normals: Float[Tensor, "n 3"], views: tuple[ObjectView, ...], light: ReflectedLight
) -> Materials:
    """Fit the lobes of an object's materials.

    Args:
        gaussians: The n Gaussians of the object, with the bands of its capture.
        normals: Unit, outward.
        views: Views of the object alone, from its capture's cameras.
        light: The light that the object was captured in.

    Returns:
        Lobes in the light's units, all 0 if the Gaussians have no bands or no camera sees them.
    """
    base = linear_from_srgb(spherical_harmonics.rgb_from_dc(gaussians.sh[:, 0]).clamp_min(0))
    n = gaussians.count
    matt = Materials(
        reflectance=torch.zeros(n, 3),
        concentration=torch.ones(n),
        dielectric=torch.zeros(n, dtype=torch.bool),
        matt=base,
        share=torch.zeros(n),
        emission=torch.zeros(n, 3),
    )
    if gaussians.sh_degree == 0 or not views:
        return matt
    record = _Record.of(gaussians, normals, views)
    cluster = _clusters(record.mean, gaussians.means, _CLUSTERS)
    reflectance, concentration, dielectric = _fitted(record, cluster, light)
    lobes = replace(
        matt,
        reflectance=reflectance[cluster],
        concentration=concentration[cluster],
        dielectric=dielectric[cluster],
    )
    old = torch.zeros(n, 3)
    for start in range(0, n, _CHUNK):
        rows = slice(start, start + _CHUNK)
        part = lobe_radiance(lobes, rows, light, normals, record.directions[rows])
        old[rows] = (record.weight[rows, :, None] * part).sum(1)
    left = torch.maximum(base - old, _MIN_MATT * base)
    taken = torch.where(old > 1e-6, (1 - _MIN_MATT) * base / old.clamp_min(1e-6), torch.zeros(())).clamp(0, 1)
    return replace(
        lobes,
        # the new light gets no more of the lobe than was subtracted under the old one
        reflectance=lobes.reflectance * taken,
        matt=left,
        share=1 - left.sum(1) / base.sum(1).clamp_min(1e-6),
    )


def lobe_radiance(
    materials: Materials,
    rows: slice,
    light: ReflectedLight,
    normals: Float[Tensor, "n 3"],
    views: Float[Tensor, "m v 3"],
) -> Float[Tensor, "m v 3"]:
    """Compute the linear rgb that the lobes of m Gaussians add in v views.

    Args:
        materials: Materials of all Gaussians.
        rows: Rows of the m Gaussians.
        light: The light at all Gaussians.
        normals: Unit, outward, of all Gaussians.
        views: Unit, from the cameras to the m Gaussians.
    """
    own, here, facing_up = materials.select(rows), light.select(rows), normals[rows]
    out = torch.zeros(views.shape)
    for value in own.concentration.unique().tolist():
        which = ((own.concentration == value) & (own.reflectance > 0).any(1)).nonzero()[:, 0]
        if len(which):
            seen, normal = views[which], facing_up[which]
            cosine = -(seen * normal[:, None]).sum(-1)
            mirrored = seen + 2 * cosine[..., None] * normal[:, None]
            part, light_there = own.select(which), here.select(which)
            radiance = light_there.radiance if part.roughness is None else light_there.ambient_radiance
            out[which] = radiance(mirrored, value) * part.fresnel(cosine)[..., None] * part.reflectance[:, None]
            if part.roughness is not None:
                out[which] += light_there.microfacet_radiance(seen, normal, part)
    return out


def _schlick(cosine: Float[Tensor, "m v"], facing: float | Float[Tensor, "m 1"]) -> Float[Tensor, "m v"]:
    return facing + (1 - facing) * (1 - cosine.clamp(0, 1)) ** 5


@dataclass(frozen=True)
class _Record:
    """Observations of n Gaussians in v views."""

    colors: Float[Tensor, "n v 3"]
    """Linear rgb, averaged over the Gaussian's pixels in each view."""
    weight: Float[Tensor, "n v"]
    """Weight of each view; the sum is 1, or 0 for a Gaussian that no view shows."""
    pixels: Float[Tensor, "n"]
    """Number of pixels that the Gaussian covers in all views."""
    directions: Float[Tensor, "n v 3"]
    """Unit, from the cameras to the Gaussian."""
    cosine: Float[Tensor, "n v"]
    """Cosine between the normal and the direction to each camera."""
    normals: Float[Tensor, "n 3"]
    """Unit, outward."""

    @property
    def mean(self) -> Float[Tensor, "n 3"]:
        """Mean colour over the views, linear rgb."""
        return (self.weight[..., None] * self.colors).sum(1)

    def mirrored(self, rows: slice | Int[Tensor, "m"]) -> Float[Tensor, "m v 3"]:
        """Mirror the view directions by the surface."""
        return self.directions[rows] + 2 * self.cosine[rows][..., None] * self.normals[rows][:, None]

    def centred(self, values: Float[Tensor, "m v 3"], rows: slice | Int[Tensor, "m"]) -> Float[Tensor, "m v 3"]:
        """Subtract each Gaussian's mean over the views from values."""
        return values - (self.weight[rows][..., None] * values).sum(1, keepdim=True)

    @staticmethod
    def of(gaussians: Gaussians, normals: Float[Tensor, "n 3"], views: tuple[ObjectView, ...]) -> "_Record":
        colors, pixels = [], []
        for view in views:
            alpha = view.operator.alpha[..., None]
            picture = view.operator.blend(spherical_harmonics.colors(gaussians.sh, view.directions))
            shown = (alpha > 0.5).float()  # thinner pixels also show the background
            linear = linear_from_srgb((picture / alpha.clamp_min(1e-6)).clamp(0, 1)) * shown
            sums = view.operator.blend_transpose(torch.cat([linear, shown], 2).contiguous())
            colors.append(sums[:, :3] / sums[:, 3:].clamp_min(1e-6))
            pixels.append(sums[:, 3])
        directions = torch.stack([view.directions for view in views], 1)
        cosine = -(directions * normals[:, None]).sum(-1)
        seen = torch.stack(pixels, 1) * (cosine > _LOWEST_COSINE)
        total = seen.sum(1)
        return _Record(
            colors=torch.stack(colors, 1),
            weight=seen / total[:, None].clamp_min(1e-6),
            pixels=total,
            directions=directions,
            cosine=cosine,
            normals=normals,
        )


def _clusters(mean: Float[Tensor, "n 3"], points: Float[Tensor, "n 3"], count: int) -> Int[Tensor, "n"]:
    """Cluster chromaticity, brightness and place by k-means; the first centres lie far apart."""
    srgb = mean.clamp_min(0) ** (1 / 2.2)
    gray = srgb.mean(1, keepdim=True)
    place = (points - points.mean(0)) / (points - points.mean(0)).norm(dim=1).quantile(0.9).clamp_min(1e-9)
    # chromaticity separates materials best, because shading changes brightness; place separates parts; set by hand
    features = torch.cat([2 * (srgb - gray) / (gray + 0.1), 0.5 * gray, 0.5 * place], 1)
    first = [int(((features - features.mean(0)) ** 2).sum(1).argmin())]
    nearest = torch.full((len(features),), torch.inf)
    for _ in range(min(count, len(features)) - 1):
        nearest = torch.minimum(nearest, ((features - features[first[-1]]) ** 2).sum(1))
        first.append(int(nearest.argmax()))
    return torch.cdist(features, k_means(features, features[first], rounds=15)).argmin(1)


def _fitted(
    record: _Record, cluster: Int[Tensor, "n"], light: ReflectedLight
) -> tuple[Float[Tensor, "c 3"], Float[Tensor, "c"], Bool[Tensor, "c"]]:
    """Fit reflectance, concentration and kind of each cluster's best lobe."""
    shapes = [(value, kind) for value in _CONCENTRATIONS for kind in (False, True)]
    count = int(cluster.max()) + 1
    own, cross, square = (torch.zeros(len(shapes), count, 3) for _ in range(3))
    fitted = torch.arange(0, len(cluster), -(-len(cluster) // _MAX_FITTED))
    for rows in fitted.split(_CHUNK // 4):
        weight = (record.pixels[rows, None] * record.weight[rows])[..., None]
        seen, mirrored, here = record.centred(record.colors[rows], rows), record.mirrored(rows), light.select(rows)
        fresnel = _schlick(record.cosine[rows], _FACING)[..., None]
        for i, (value, kind) in enumerate(shapes):
            if not kind:
                radiance = here.radiance(mirrored, value)
            lobe = record.centred(radiance * fresnel if kind else radiance, rows)
            for sums, term in ((own, lobe * lobe), (cross, lobe * seen), (square, seen * seen)):
                sums[i].index_add_(0, cluster[rows], (weight * term).sum(1))
    reflectance = (cross / own.clamp_min(1e-9)).clamp_min(0)
    explained = ((2 * reflectance * cross - reflectance**2 * own).sum(2) / square.sum(2).clamp_min(1e-9)).clamp(0, 1)
    best = explained.argmax(0)
    each = torch.arange(count)
    share = explained[best, each]
    believed = share / (share + _EVIDENCE)
    values = torch.tensor([value for value, _ in shapes])
    kinds = torch.tensor([kind for _, kind in shapes])
    return believed[:, None] * reflectance[best, each], values[best], kinds[best]


_GLOSS_CHUNK = 4096  # Gaussians at a time; bounds memory
_VIEWS = 64  # directions over the sphere; twice the number that integrates products of degree 3 exactly
_BEHIND = 0.1  # weight of views from behind a known surface; .03 gives the same pictures
_BRIGHTEST = 1.5  # linear; brighter reflections are clipped, so that bands do not ring over the whole object


def gloss_bands(
    gaussians: Gaussians,
    normals: Float[Tensor, "n 3"],
    materials: Materials,
    light: ReflectedLight,
    *,
    shade: Float[Tensor, "n 3"],
) -> Float[Tensor, "n 16 3"]:
    """Compute coefficients that are added after shading, when the old bands are removed; 0 for matt Gaussians.

    Args:
        gaussians: The object.
        normals: Unit, outward.
        materials: Materials of the object.
        light: The light at the new place, in the units of the old light.
        shade: Factor on the linear rgb of matt colours.
    """
    degree = spherical_harmonics.MAX_DEGREE
    views = even_directions(_VIEWS)
    basis = spherical_harmonics.basis(views, degree)
    project = basis * (4 * math.pi / _VIEWS)
    out = torch.zeros(gaussians.count, project.shape[1], 3)
    light = light if materials.roughness is None else light.windowed()
    for start in range(0, gaussians.count, _GLOSS_CHUNK):
        rows = slice(start, start + _GLOSS_CHUNK)
        glossy = materials.glossy[rows]
        if not bool(glossy.any()):
            continue
        facing = normals[rows][:, None]
        towards = -(views * facing).sum(-1)
        # views from behind the surface take the reflection of their mirror image in front
        in_front = views + (towards - towards.abs())[..., None] * facing
        lobe = lobe_radiance(materials, rows, light, normals, in_front)
        linear = (materials.matt[rows] * shade[rows])[:, None] + lobe + materials.emission[rows][:, None]
        srgb = srgb_from_linear(linear.clamp(0, _BRIGHTEST))
        if materials.roughness is None:
            bands = torch.einsum("vk,nvc->nkc", project, srgb - 0.5)
        else:
            # a known surface hides itself from behind, so the bands serve the views in front
            weights = torch.where(towards > 0, 1.0, _BEHIND)
            squares = torch.einsum("nv,vk,vl->nkl", weights, basis, basis)
            bands = torch.linalg.solve(squares, torch.einsum("nv,vk,nvc->nkc", weights, basis, srgb - 0.5))
        bands[:, 0] -= apply_gain(gaussians.select(torch.arange(gaussians.count)[rows]), shade[rows]).sh[:, 0]
        out[rows] = bands * glossy[:, None, None]
    return out
