//! What the network sees: voxel grids, sparse depth, image planes.
