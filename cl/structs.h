// Structs passed by value; clsplat/structs.py holds the matching NumPy dtypes, a test compares the sizes.
// Reals come first and the ints are even in number, so that neither build needs padding.
#ifndef CLSPLAT_STRUCTS_H
#define CLSPLAT_STRUCTS_H

typedef struct {
    real rotation[9];    // world to camera, row-major
    real translation[3]; // world to camera, world units
    real position[3];    // camera centre, world units
    real fx, fy, cx, cy; // px
    int width, height;   // px
} Camera;

#endif
