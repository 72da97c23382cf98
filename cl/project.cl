// Stage project: projects Gaussians to splats, and propagates gradients back.
//
// Computes for each Gaussian its centre in the image, the inverse of its 2D covariance (EWA splatting with the local
// affine approximation J of the projection), its depth, the half widths of the box outside of which alpha < ALPHA_MIN,
// its opacity and its colour:
//   cov2d = J W Sigma W^T J^T + BLUR I,  Sigma = R S S^T R^T          (Kerbl et al. 2023, equations 5 and 6)
//   colour = max(SH(direction) + 1/2, 0)                               (original code)
//   antialiased: opacity * sqrt(det(cov2d - BLUR I)/det(cov2d))        (Yu et al. 2024, "Mip-Splatting", equation 10)
// If each pixel is sorted, also the disparity 1/z at which the ray of a pixel meets it (project_disparities).
// docs/stages/project.md derives the gradients; clsplat/reference/project.py is the float64 twin.
//
// Mapping: one work-item per Gaussian, no local memory except for CAMERA_GRAD.
//
// Buffers, N Gaussians with K = (degree + 1)^2 coefficients stored, C = CHANNELS:
//   in   means[N,3] world, log_scales[N,3] ln(world), quats[N,4] wxyz of any norm, logit_opacities[N], sh[N,K,3]
//   out  means2d[N,2] px, conics[N,3] px^-2 (xx, xy, yy), depths[N] world, extents[N,2] px, opacities[N],
//        colors[N,C] (RGB, then the depth if C is 4)
//        An invisible Gaussian has extents 0 and all its other outputs 0.
//   out  disparities[N,3] of project_disparities: 1/z at the centre in 1/world, and its derivatives by x and y per px
//   v_x  is the gradient with respect to x; v_camera[groups,16] holds a partial sum per work-group of the gradient
//        with respect to rotation (9, row-major), translation (3) and fx, fy, cx, cy.
//
// Arguments of every kernel: numbers and structs; the Gaussians' fields, Adam's moments, the splats' fields and the
// gradients, each in the order of its container (clsplat/gaussians.py, clsplat/stages.py); results.
//
// -DCHANNELS=3|4      4: the depth is composited as a fourth channel
// -DANTIALIASED=0|1   1: opacity compensation
// -DCAMERA_GRAD=0|1   1: the backward kernels also write v_camera; requires -DGROUP, the work-group size
// -DLENS=PINHOLE|ORTHOGRAPHIC|FISHEYE  camera model (lens.h)
#include "common.h"
#include "adam.h"
#include "ellipse.h"
#include "linalg.h"
#include "power.h"
#include "sh.h"
#include "structs.h"
#include "lens.h"

#if !defined(CHANNELS) || (CHANNELS != 3 && CHANNELS != 4)
#error "-DCHANNELS must be 3 (RGB) or 4 (RGB and depth)"
#endif
#if !defined(ANTIALIASED) || !defined(CAMERA_GRAD) || ANTIALIASED & ~1 || CAMERA_GRAD & ~1
#error "-DANTIALIASED and -DCAMERA_GRAD must be 0 or 1"
#endif
#if CAMERA_GRAD && (!defined(GROUP) || GROUP < 1)
#error "-DCAMERA_GRAD=1 needs -DGROUP, the work-group size of the backward kernels"
#endif

// Intermediate values of one Gaussian for the forward and the backward pass.
typedef struct {
    real3 p;         // centre, camera frame
    Lens lens;       // J and the depth at the centre
    mat3 rotation;   // of the Gaussian
    real3 scales;    // standard deviations, world units
    real3 t0, t1;    // rows of J W
    real3 b0, b1;    // rows of J W R S: cov2d = B B^T + BLUR I
    real xx, xy, yy; // cov2d
    real det0, det;  // determinants of cov2d without and with the blur
} Footprint;

static inline Footprint footprint(const Camera *camera, real3 mean, real3 scales, real4 unit_quat) {
    Footprint f;
    const mat3 view = camera_rotation(camera);
    f.p = mat3_mul(view, mean) + (real3)(camera->translation[0], camera->translation[1], camera->translation[2]);
    f.lens = lens(camera, f.p);
    f.t0 = mat3_tmul(view, f.lens.j0);
    f.t1 = mat3_tmul(view, f.lens.j1);
    f.rotation = rotation_from_quat(unit_quat);
    f.scales = scales;
    f.b0 = mat3_tmul(f.rotation, f.t0) * f.scales;
    f.b1 = mat3_tmul(f.rotation, f.t1) * f.scales;
    const real xx = dot3(f.b0, f.b0), yy = dot3(f.b1, f.b1);
    // |b0 x b1|^2 = xx yy - xy^2 (Lagrange), without the cancellation that makes a needle's determinant
    // negative.
    const real3 normal = cross3(f.b0, f.b1);
    f.det0 = dot3(normal, normal);
    f.det = f.det0 + BLUR * (xx + yy) + BLUR * BLUR;
    f.xx = xx + BLUR;
    f.xy = dot3(f.b0, f.b1);
    f.yy = yy + BLUR;
    return f;
}

typedef struct {
    real3 p, log_scales, mean;
    real4 quat; // of the unit quaternion
    mat3 view;
    real4 intrinsics;
} FootprintGrad;

// v_xx, v_xy, v_yy: gradients of cov2d, where xy stands for both off-diagonal entries.
static inline FootprintGrad footprint_vjp(const Camera *camera, const Footprint *f, real3 mean, real4 unit_quat,
                                          real3 v_cov, real2 v_mean2d, real v_depth) {
    FootprintGrad v;
    const mat3 view = camera_rotation(camera);
    const real3 v_b0 = 2 * v_cov.x * f->b0 + v_cov.y * f->b1;
    const real3 v_b1 = 2 * v_cov.z * f->b1 + v_cov.y * f->b0;

    // b = S R^T t
    const real3 scaled0 = f->scales * v_b0, scaled1 = f->scales * v_b1;
    v.log_scales = f->b0 * v_b0 + f->b1 * v_b1;
    v.quat = rotation_from_quat_vjp(unit_quat, mat3_outer2(f->t0, scaled0, f->t1, scaled1));
    const real3 v_t0 = mat3_mul(f->rotation, scaled0), v_t1 = mat3_mul(f->rotation, scaled1);

    // t = W^T j
    const real3 v_j0 = mat3_mul(view, v_t0), v_j1 = mat3_mul(view, v_t1);
    v.view = mat3_outer2(f->lens.j0, v_t0, f->lens.j1, v_t1);
    v.p = lens_vjp(camera, f->p, &f->lens, v_mean2d, v_j0, v_j1, v_depth, &v.intrinsics);

    // p = W mean + translation
    v.mean = mat3_tmul(view, v.p);
    v.view.row0 += v.p.x * mean;
    v.view.row1 += v.p.y * mean;
    v.view.row2 += v.p.z * mean;
    return v;
}

// Factor on the opacity, and the gradients of the determinants with respect to it.
static inline real compensation(real det0, real det) {
#if ANTIALIASED
    return sqrt(GREATER(det0 / det, (real)(COMPENSATION_MIN * COMPENSATION_MIN)));
#else
    return 1;
#endif
}

static inline real2 compensation_vjp(real det0, real det, real v_factor) {
#if ANTIALIASED
    const real ratio = det0 / det;
    if (ratio <= (real)(COMPENSATION_MIN * COMPENSATION_MIN))
        return 0;
    const real v_ratio = v_factor * (real)0.5 / sqrt(ratio);
    return (real2)(v_ratio / det, -v_ratio * ratio / det);
#else
    return 0;
#endif
}

DEFINE_POWER(4)

// Scales in x, y, z and the opacity in w. Overflow gives infinity, underflow the smallest normal number; NaN stays NaN.
static inline real4 activate(real3 log_scales, real logit_opacity) {
    const real4 t = (real)LOG2_E * (real4)(log_scales, -logit_opacity);
    real4 e = t == t ? power4(CLAMP(t, (real4)POWER_MIN, (real4)POWER_MAX)) : t;
    e.w = 1 / (1 + e.w);
    return e;
}

// conic (xx, xy, yy) = inverse of cov2d: v_cov = -Q V Q with the symmetric matrix V of (v_xx, v_xy/2, v_yy).
static inline real3 conic_vjp(real3 q, real3 v) {
    return -(real3)(q.x * q.x * v.x + q.x * q.y * v.y + q.y * q.y * v.z,
                    2 * q.x * q.y * v.x + (q.y * q.y + q.x * q.z) * v.y + 2 * q.y * q.z * v.z,
                    q.y * q.y * v.x + q.y * q.z * v.y + q.z * q.z * v.z);
}

__kernel void project_fwd(const uint n, const Camera camera, const int sh_stride, const int sh_degree,
                          const __global real *means, const __global real *log_scales, const __global real *quats,
                          const __global real *logit_opacities, const __global real *sh, __global real *means2d,
                          __global real *conics, __global real *depths, __global real *extents,
                          __global real *opacities, __global real *colors) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;

    const real3 mean = load3(means, i);
    const real4 quat = load4(quats, i);
    const real norm2 = dot4(quat, quat);
    const real4 activated = activate(load3(log_scales, i), logit_opacities[i]);
    const Footprint f = footprint(&camera, mean, activated.xyz, quat / sqrt(norm2));
    const real opacity = activated.w * compensation(f.det0, f.det);
    const real r2 = ellipse_r2(opacity);
    const real2 centre = lens_centre(&camera, f.p);
    const real2 extent = sqrt(r2 * (real2)(f.xx, f.yy));
    const real3 offset = lens_offset(&camera, mean), direction = offset / sqrt(dot3(offset, offset));
    real basis[16];
    sh_basis(direction, sh_degree, basis);
    real3 color = (real)0.5;
    for (int k = 0; k < (sh_degree + 1) * (sh_degree + 1); ++k)
        color += basis[k] * load3(sh, i * sh_stride + k);

    // 0 times infinity is NaN, so that one test detects values that are not finite in any term.
    const real any =
        norm2 + f.det + f.lens.depth + centre.x + centre.y + extent.x + extent.y + color.x + color.y + color.z;
    bool visible = 0 * any == 0 && lens_sees(&camera, f.p) && norm2 >= QUAT_NORM2_MIN && r2 > 0;
    if (visible) {
        const int2 columns = pixels_between(centre.x - extent.x, centre.x + extent.x, camera.width);
        const int2 rows = pixels_between(centre.y - extent.y, centre.y + extent.y, camera.height);
        visible = columns.x <= columns.y && rows.x <= rows.y;
    }
    store2(means2d, i, visible ? centre : (real2)0);
    store3(conics, i, visible ? (real3)(f.yy, -f.xy, f.xx) / f.det : (real3)0);
    depths[i] = visible ? f.lens.depth : 0;
    store2(extents, i, visible ? extent : (real2)0);
    opacities[i] = visible ? opacity : 0;
    for (int k = 0; k < 3; ++k)
        colors[CHANNELS * i + k] = visible ? GREATER(((const real *)&color)[k], (real)0) : 0;
#if CHANNELS == 4
    colors[CHANNELS * i + 3] = visible ? f.lens.depth : 0;
#endif
}

// Depth of a Gaussian's maximum along the ray of a pixel. In the local affine approximation, depth and image position
// are jointly normal. For a pixel at d from the centre, the maximum is at the conditional mean of the depth,
//   z + g.d,   g = cov2d^-1 (J W Sigma W^T e_z).
// The disparity 1/z of a plane is affine in the image. 1/z - (g/z^2).d has the same value and slope at the centre, and
// is exact for discs (cf. Radl et al. 2024, "StopThePop", equation 10, for the Gaussian without blur).
__kernel void project_disparities(const uint n, const Camera camera, const __global real *means,
                                  const __global real *log_scales, const __global real *quats,
                                  const __global real *conics, const __global real *extents,
                                  __global real *disparities) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    real3 disparity = 0;
    if (extents[2 * i] > 0) {
        const real4 quat = load4(quats, i);
        const Footprint f =
            footprint(&camera, load3(means, i), activate(load3(log_scales, i), 0).xyz, quat / sqrt(dot4(quat, quat)));
        const real3 b2 = mat3_tmul(f.rotation, mat3_tmul(camera_rotation(&camera), f.lens.onward)) * f.scales,
                    conic = load3(conics, i);
        const real xz = dot3(f.b0, b2), yz = dot3(f.b1, b2), inv_z = 1 / f.lens.depth;
        const real2 slope = -inv_z * inv_z * (real2)(conic.x * xz + conic.y * yz, conic.y * xz + conic.z * yz);
        // Disparities that are not finite at some pixel have no order.
        const bool finite = 0 * (slope.x * extents[2 * i] + slope.y * extents[2 * i + 1]) == 0;
        disparity = (real3)(inv_z, finite ? slope : (real2)0);
    }
    store3(disparities, i, disparity);
}

// Gradients of one visible Gaussian. Those with respect to its spherical harmonics are given by factors: the gradient
// of coefficient k is basis[k] color.
typedef struct {
    FootprintGrad geometry;
    real logit_opacity;
    real3 color;
    real basis[16];
} GaussianGrad;

typedef struct {
    const __global real *means, *log_scales, *quats, *logit_opacities, *sh;
} GaussianArrays;

typedef struct {
    const __global real *conics, *colors, *v_means2d, *v_conics, *v_opacities, *v_colors;
} SplatArrays;

static inline GaussianGrad gaussian_vjp(size_t i, const Camera *camera, int sh_stride, int sh_degree,
                                        GaussianArrays gaussians, SplatArrays splats) {
    GaussianGrad v;
    const real3 mean = load3(gaussians.means, i);
    const real4 quat = load4(gaussians.quats, i);
    const real4 unit_quat = quat / sqrt(dot4(quat, quat));
    const real4 activated = activate(load3(gaussians.log_scales, i), gaussians.logit_opacities[i]);
    const Footprint f = footprint(camera, mean, activated.xyz, unit_quat);

    const real opacity = activated.w, factor = compensation(f.det0, f.det), v_opacity = splats.v_opacities[i];
    v.logit_opacity = v_opacity * factor * opacity * (1 - opacity);
    const real2 v_det = compensation_vjp(f.det0, f.det, v_opacity * opacity);
    real3 v_cov = conic_vjp(load3(splats.conics, i), load3(splats.v_conics, i));
    v_cov += v_det.x * (real3)(f.yy - BLUR, -2 * f.xy, f.xx - BLUR) + v_det.y * (real3)(f.yy, -2 * f.xy, f.xx);

    real v_depth = 0;
#if CHANNELS == 4
    v_depth = splats.v_colors[CHANNELS * i + 3];
#endif
    v.geometry = footprint_vjp(camera, &f, mean, unit_quat, v_cov, load2(splats.v_means2d, i), v_depth);
    v.geometry.quat = normalize_quat_vjp(quat, v.geometry.quat);

    // Colour. If it is clamped at 0, its gradient is 0.
    const __global real *color = splats.colors + CHANNELS * i, *v_color = splats.v_colors + CHANNELS * i;
    v.color.x = color[0] > 0 ? v_color[0] : 0;
    v.color.y = color[1] > 0 ? v_color[1] : 0;
    v.color.z = color[2] > 0 ? v_color[2] : 0;
    const real3 offset = lens_offset(camera, mean), direction = offset / sqrt(dot3(offset, offset));
    real v_basis[16];
    sh_basis(direction, sh_degree, v.basis);
    for (int k = 0; k < (sh_degree + 1) * (sh_degree + 1); ++k)
        v_basis[k] = dot3(load3(gaussians.sh, i * sh_stride + k), v.color);
    const real3 v_offset = normalize_vjp(offset, sh_basis_vjp(direction, sh_degree, v_basis));
#if LENS == ORTHOGRAPHIC
    v.geometry.view.row2 += v_offset;
#else
    v.geometry.mean += v_offset;

    // position = -W^-1 translation: v_translation = W v_offset, v_W = (W v_offset) position^T
    const real3 v_translation = mat3_mul(camera_rotation(camera), v_offset);
    const real3 position = (real3)(camera->position[0], camera->position[1], camera->position[2]);
    v.geometry.p += v_translation;
    v.geometry.view.row0 += v_translation.x * position;
    v.geometry.view.row1 += v_translation.y * position;
    v.geometry.view.row2 += v_translation.z * position;
#endif

    // Gradients that overflow would make Adam's moments NaN permanently: they are set to 0 for this view.
    const real3 sum = v.geometry.mean + v.geometry.log_scales + v.geometry.p + v.geometry.quat.xyz + v.color +
                      v.geometry.view.row0 + v.geometry.view.row1 + v.geometry.view.row2;
    real any = sum.x + sum.y + sum.z + v.geometry.quat.w + v.logit_opacity;
#if CAMERA_GRAD
    any += dot4(v.geometry.intrinsics, (real4)1);
#endif
    const GaussianGrad none = {0};
    return 0 * any == 0 ? v : none;
}

#if CAMERA_GRAD
// Adds up the camera's gradient over the work-group, in the order of its work-items.
static inline void sum_camera(const FootprintGrad *v, __local real *partial, __global real *v_camera) {
    const uint lane = get_local_id(0);
    vstore3(v->view.row0, 0, partial + 16 * lane);
    vstore3(v->view.row1, 1, partial + 16 * lane);
    vstore3(v->view.row2, 2, partial + 16 * lane);
    vstore3(v->p, 3, partial + 16 * lane);
    vstore4(v->intrinsics, 3, partial + 16 * lane);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = lane; k < 16; k += GROUP) {
        real sum = 0;
        for (uint j = 0; j < GROUP; ++j)
            sum += partial[16 * j + k];
        v_camera[16 * get_group_id(0) + k] = sum;
    }
}
#endif

__kernel void project_bwd(const uint n, const Camera camera, const int sh_stride, const int sh_degree,
                          const __global real *means, const __global real *log_scales, const __global real *quats,
                          const __global real *logit_opacities, const __global real *sh, const __global real *conics,
                          const __global real *extents, const __global real *colors, const __global real *v_means2d,
                          const __global real *v_conics, const __global real *v_opacities,
                          const __global real *v_colors, __global real *v_means, __global real *v_log_scales,
                          __global real *v_quats, __global real *v_logit_opacities, __global real *v_sh
#if CAMERA_GRAD
                          ,
                          __global real *v_camera
#endif
) {
    const size_t i = get_global_id(0);
    GaussianGrad v = {0};
    if (i < n) {
        const bool visible = extents[2 * i] > 0;
        const int active = visible ? (sh_degree + 1) * (sh_degree + 1) : 0;
        if (visible) {
            const GaussianArrays gaussians = {means, log_scales, quats, logit_opacities, sh};
            const SplatArrays splats = {conics, colors, v_means2d, v_conics, v_opacities, v_colors};
            v = gaussian_vjp(i, &camera, sh_stride, sh_degree, gaussians, splats);
        }
        for (int k = 0; k < sh_stride; ++k)
            store3(v_sh, i * sh_stride + k, k < active ? v.basis[k] * v.color : (real3)0);
        store3(v_means, i, v.geometry.mean);
        store3(v_log_scales, i, v.geometry.log_scales);
        store4(v_quats, i, v.geometry.quat);
        v_logit_opacities[i] = v.logit_opacity;
    }

#if CAMERA_GRAD
    __local real partial[16 * GROUP];
    sum_camera(&v.geometry, partial, v_camera);
#endif
}

// project_bwd and the step of Adam (adam.cl) in one pass, with the gradients in registers.
__kernel void project_bwd_adam(const uint n, const Camera camera, const int sh_stride, const int sh_degree,
                               const Adam adam, __global real *means, __global real *log_scales, __global real *quats,
                               __global real *logit_opacities, __global real *sh, __global real *means_1,
                               __global real *log_scales_1, __global real *quats_1, __global real *logit_opacities_1,
                               __global real *sh_1, __global real *means_2, __global real *log_scales_2,
                               __global real *quats_2, __global real *logit_opacities_2, __global real *sh_2,
                               const __global real *conics, const __global real *extents, const __global real *colors,
                               const __global real *v_means2d, const __global real *v_conics,
                               const __global real *v_opacities, const __global real *v_colors
#if CAMERA_GRAD
                               ,
                               __global real *v_camera
#endif
) {
    const size_t i = get_global_id(0);
    GaussianGrad v = {0};
    if (i < n && extents[2 * i] > 0) {
        const GaussianArrays gaussians = {means, log_scales, quats, logit_opacities, sh};
        const SplatArrays splats = {conics, colors, v_means2d, v_conics, v_opacities, v_colors};
        v = gaussian_vjp(i, &camera, sh_stride, sh_degree, gaussians, splats);
    }
#if CAMERA_GRAD
    __local real partial[16 * GROUP];
    sum_camera(&v.geometry, partial, v_camera);
#endif
    if (i >= n)
        return;
    if (adam.opacity_penalty != 0 || adam.scale_penalty != 0) {
        const real4 activated = activate(load3(log_scales, i), logit_opacities[i]);
        v.logit_opacity += adam.opacity_penalty * activated.w * (1 - activated.w);
        v.geometry.log_scales += adam.scale_penalty * activated.xyz;
    }
    if (adam.erank_penalty != 0)
        v.geometry.log_scales += adam.erank_penalty * erank_vjp(load3(log_scales, i), adam.erank_slack);

    const real16 rates =
        (real16)((real3)adam.means, (real3)adam.log_scales, (real4)adam.quats, adam.logit_opacities, (real4)0, 0);
    const real16 g = (real16)(v.geometry.mean, v.geometry.log_scales, v.geometry.quat, v.logit_opacity, (real4)0, 0);
    real16 p = (real16)(load3(means, i), load3(log_scales, i), load4(quats, i), logit_opacities[i], (real4)0, 0);
    real16 m =
        (real16)(load3(means_1, i), load3(log_scales_1, i), load4(quats_1, i), logit_opacities_1[i], (real4)0, 0);
    real16 w =
        (real16)(load3(means_2, i), load3(log_scales_2, i), load4(quats_2, i), logit_opacities_2[i], (real4)0, 0);
    p = adam_update(&adam, rates, p, g, &m, &w);
    store3(means, i, p.s012);
    store3(means_1, i, m.s012);
    store3(means_2, i, w.s012);
    store3(log_scales, i, p.s345);
    store3(log_scales_1, i, m.s345);
    store3(log_scales_2, i, w.s345);
    store4(quats, i, p.s6789);
    store4(quats_1, i, m.s6789);
    store4(quats_2, i, w.s6789);
    logit_opacities[i] = p.sa;
    logit_opacities_1[i] = m.sa;
    logit_opacities_2[i] = w.sa;

    const int width = 3 * (sh_degree + 1) * (sh_degree + 1);
    real16 v_sh[3];
    for (int k = 0; k < width; ++k)
        ((real *)v_sh)[k] = v.basis[k / 3] * ((const real *)&v.color)[k % 3];
    real16 sh_rates = adam.sh_rest;
    sh_rates.s012 = adam.sh0;
    const size_t first = i * 3 * sh_stride;
    for (int k = 0; k < width; k += 16, sh_rates = adam.sh_rest) {
        __global real *q = sh + first + k, *q_1 = sh_1 + first + k, *q_2 = sh_2 + first + k;
        if (k + 16 > width) {
            adam_update_some(&adam, sh_rates, width - k, v_sh[k / 16], q, q_1, q_2);
            break;
        }
        real16 q_m = load16(q_1), q_v = load16(q_2);
        store16(q, adam_update(&adam, sh_rates, load16(q), v_sh[k / 16], &q_m, &q_v));
        store16(q_1, q_m);
        store16(q_2, q_v);
    }
}
