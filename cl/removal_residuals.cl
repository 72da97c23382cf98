// Stage removal: residuals of an image.
//
//   residuals = image - photo/255
// See docs/stages/removal.md; clsplat/reference/removal.py is the twin.
//
// Mapping: one work-item per number. It computes in double precision where the device has that, and rounds once.
//
// Buffers, n = 3 H W: in image[n]; photo[n] uchar; out residuals[n]
// clamped: whether the image is clamped to [0, 1]
#include "common.h"

#pragma OPENCL FP_CONTRACT OFF
#ifdef cl_khr_fp64
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double wide;
#else
typedef real wide;
#endif

__kernel void removal_residuals(const uint n, const uint clamped, const __global real *image,
                                const __global uchar *photo, __global real *residuals) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    const real shown = clamped ? clamp(image[i], (real)0, (real)1) : image[i];
    residuals[i] = (real)((wide)shown - (wide)photo[i] / 255);
}
