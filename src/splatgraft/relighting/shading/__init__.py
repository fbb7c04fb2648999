"""How surfaces answer to light: normals, irradiance, reflection, and the change between two lights."""
