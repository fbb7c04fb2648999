"""Shadows: change of the light around objects, computed from depth maps and averaged over the scene's Gaussians.

`relighting/cast_shadows.py: cast_shadows` runs these steps. Each has one function to start from:

1. Splat depth maps of the scene and of each object from every light sample: `scene_ratio.scene_shadow_maps` and
   `scene_ratio.object_shadow_maps`, by `shadow_maps.splat_depth_maps`.
2. Select the scene's Gaussians whose light an object may change: `scene_ratio.reachable`.
3. Find the share of every light sample that the scene lets through to them: `scene_ratio.scene_visibility`, by
   `shadow_maps.visibility`.
4. Sum the light with and without the object at points: `scene_ratio.light_sums`, by `occlusion.occluded_irradiance`
   (penumbrae, bounce). Limit the ratio: `scene_ratio.ratio_from_sums`.
5. Average the ratio over Gaussians and split wide ones at shadow edges: `receivers.shade_receivers`.
6. Find the surface point and its ratio in each pixel of some views: `surface_views.views_of_surface`.
7. Fit the ratios to these views: `view_fit.fit_to_views`.
8. Compute shadows of objects on one another: `scene_ratio.scene_ratio`; of an object on itself:
   `scene_ratio.self_visibility`.

Steps 1 and 3 run before `cast_shadows`, when light and objects are prepared. They stay valid while objects move.
"""
