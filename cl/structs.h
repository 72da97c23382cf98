// Structs that are passed by value. clsplat/structs.py has the matching NumPy dtypes; a test compares the sizes.
// Reals come first, and the number of ints is even, so that neither build needs padding.
#ifndef CLSPLAT_STRUCTS_H
#define CLSPLAT_STRUCTS_H

typedef struct {
    real rotation[9];    // world to camera, row-major
    real translation[3]; // world to camera, world units
    real position[3];    // camera centre, world units
    real fx, fy, cx, cy; // px
    real k1, k2, k3, k4; // FISHEYE: coefficients of its polynomial (lens.h)
    real cos_max;        // FISHEYE: cosine of the largest visible angle from the axis
    real near;           // depth of the near plane, world units
    int width, height;   // px
} Camera;

// One step of Adam. Rates are divided by 1 - beta1^t; take is 1 - keep.
typedef struct {
    real means, log_scales, quats, logit_opacities, sh0, sh_rest; // rates by parameter
    real keep1, take1, keep2, take2;                              // beta1, beta2
    real inv_correction2;                                         // 1/(1 - beta2^t)
    real eps;
    real opacity_penalty, scale_penalty; // weights in the loss of the sums of all opacities and scales,
    real erank_penalty, erank_slack;     // and of the penalty of the effective ranks (adam.h)
} Adam;

#endif
