// Stage removal: residuals of an image, and its squared error in each pixel.
//
//   residuals = image - photo/255,   errors = (sum over RGB of residuals^2, 0, 0) where the mask is set
// The first is what the other kernels of the stage take. The second has the form of a gradient with respect to the
// image: compositing divides what is in its first channel among the splats by their weights.
// See docs/stages/removal.md; clsplat/reference/removal.py is the twin.
//
// Mapping: one work-item per pixel. It computes in double precision where the device has that, and rounds once.
//
// Buffers: in image[H,W,3]; photo[H,W,3] uchar; mask[H,W] uchar, not read where masked is 0
//          out residuals[H,W,3], errors[H,W,3]
// clamped: whether the image is clamped to [0, 1]
#include "common.h"

#pragma OPENCL FP_CONTRACT OFF
#ifdef cl_khr_fp64
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double wide;
#else
typedef real wide;
#endif

__kernel void removal_residuals(const uint pixels, const uint clamped, const uint masked, const __global real *image,
                                const __global uchar *photo, const __global uchar *mask, __global real *residuals,
                                __global real *errors) {
    const size_t i = get_global_id(0);
    if (i >= pixels)
        return;
    wide sum = 0;
    for (size_t k = 3 * i; k < 3 * i + 3; ++k) {
        const real shown = clamped ? clamp(image[k], (real)0, (real)1) : image[k];
        const wide residual = (wide)shown - (wide)photo[k] / 255;
        residuals[k] = (real)residual;
        errors[k] = 0;
        sum += residual * residual;
    }
    errors[3 * i] = masked && !mask[i] ? 0 : (real)sum;
}
