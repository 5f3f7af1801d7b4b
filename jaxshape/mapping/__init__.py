"""From an RGB-D recording to the object in it: segmentation, tracking, placement and the map.

The modules; each imports only from those above it:

    config         settings of tracking and mapping
    segmentation   which pixels of a depth frame show the object
    tracking       the pose of a frame, and what a keyframe keeps of it
    placement      where the object stands, how it is turned and how large it is
    map            keyframes, fused and realigned with the shapes that explain them
    scene          several objects of several classes: detected, tracked and classified
"""
