"""Preview images of the edited scene, with full or draft relighting."""
