"""Bodies: from URDFs, meshes, clouds and primitives to convex shapes, and which pairs of them can collide."""
