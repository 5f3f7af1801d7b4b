"""Where a camera should look next: candidate views, their visible voxels and information gain."""
