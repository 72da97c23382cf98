// Stage project: projects Gaussians to splats, and propagates gradients back.
//
// Computes for each Gaussian its centre in the image, the inverse of its 2D covariance (EWA splatting with the local
// affine approximation J of the projection), its depth, the half widths of the box outside of which alpha < ALPHA_MIN,
// its opacity and its colour:
//   cov2d = J W Sigma W^T J^T + BLUR I,  Sigma = R S S^T R^T          (Kerbl et al. 2023, equations 5 and 6)
//   colour = max(SH(direction) + 1/2, 0)                               (original code)
//   antialiased: opacity * sqrt(det(cov2d - BLUR I)/det(cov2d))        (Yu et al. 2024, "Mip-Splatting", equation 10)
// With RAYS, the covariance is that of gaussian_rays.h, and the shape is not approximated.
// If each pixel is sorted, also the disparity 1/z at which the ray of a pixel meets it (project_disparities).
// docs/stages/project.md derives the gradients; clsplat/reference/project.py is the float64 twin.
//
// Mapping: a work-item takes the next LANES Gaussians (lanes.h). With LANES=1, the coefficients of spherical harmonics
// are 4/5 of all parameters, and those of one Gaussian lie together: work-items that each went through a row of their
// own would read and write scattered addresses. In the backward kernels, the work-items of a group therefore take the
// coefficients of the group's Gaussians one after the other, from the gradients in local memory.
// Local memory: 19 GROUP reals with LANES=1, and 16 GROUP with CAMERA_GRAD: 9 KiB for 64 work-items.
//
// Buffers, N Gaussians with K = (degree + 1)^2 coefficients stored, C = CHANNELS:
//   in   means[N,3] world, log_scales[N,3] ln(world), quats[N,4] wxyz of any norm, logit_opacities[N], sh[N,K,3]
//   out  means2d[N,2] px, conics[N,3] px^-2 (xx, xy, yy), depths[N] world, extents[N,2] px, opacities[N],
//        colors[N,C] (RGB, then the depth if C is 4)
//        An invisible Gaussian has extents 0 and all its other outputs 0.
//   out  rays[N,RAY_REALS], the terms along rays (gaussian_rays.h), with RAYS; means2d, conics and extents are then the outline
//   out  disparities[N,3] of project_disparities: 1/z at the centre in 1/world, and its derivatives by x and y per px
//   v_x  is the gradient with respect to x; v_camera[groups,16] holds a partial sum per work-group of the gradient
//        with respect to rotation (9, row-major), translation (3) and fx, fy, cx, cy.
//
// Arguments of every kernel: numbers and structs; the Gaussians' fields, Adam's moments, the splats' fields and the
// gradients, each in the order of its container (clsplat/gaussians.py, clsplat/stages.py); results.
//
// -DCHANNELS=3|4      4: the depth is composited as a fourth channel
// -DANTIALIASED=0|1   1: opacity compensation
// -DCAMERA_GRAD=0|1   1: the backward kernels also write v_camera
// -DLENS=PINHOLE|ORTHOGRAPHIC|FISHEYE|EQUIRECTANGULAR  camera model (lens.h); the last one needs RAYS
// -DRAYS=0|1          1: Gaussians are evaluated along rays; not with ORTHOGRAPHIC, whose affine projection is exact
// -DLANES=1|8         Gaussians of a work-item
// -DGROUP             number of work-items of a work-group of the backward kernels
#ifndef LANES
#error "-DLANES, the number of Gaussians of a work-item, must be given"
#endif
#include "common.h"
#include "adam.h"
#include "ellipse.h"
#include "lens.h"
#include "sh.h"

#if !defined(CHANNELS) || (CHANNELS != 3 && CHANNELS != 4)
#error "-DCHANNELS must be 3 (RGB) or 4 (RGB and depth)"
#endif
#if !defined(ANTIALIASED) || !defined(CAMERA_GRAD) || ANTIALIASED & ~1 || CAMERA_GRAD & ~1
#error "-DANTIALIASED and -DCAMERA_GRAD must be 0 or 1"
#endif
#if !defined(RAYS) || RAYS & ~1
#error "-DRAYS must be 0 or 1"
#endif
#if LENS == EQUIRECTANGULAR && !RAYS || LENS == ORTHOGRAPHIC && RAYS
#error "-DLENS=EQUIRECTANGULAR needs -DRAYS=1, and -DLENS=ORTHOGRAPHIC needs -DRAYS=0"
#endif
#if !defined(GROUP) || GROUP < 1
#error "-DGROUP must give the work-group size of the backward kernels, 1 or more"
#endif

// Number of spherical harmonics' coefficients that are rearranged together, and of their chunks. FOR_COEFFICIENTS takes
// the first of each such group, below `end`. Where a work-item takes one Gaussian, its bounds are constants: the loop is
// unrolled, and the basis stays in registers.
#if LANES == 1
#define COEFFICIENTS 1
#define FOR_COEFFICIENTS(first, end)                                                                                 \
    for (int first = 0; first < 16; ++first)                                                                         \
        if (first < (end))
#else
#define COEFFICIENTS                 8
#define FOR_COEFFICIENTS(first, end) for (int first = 0; first < (end); first += COEFFICIENTS)
#endif
#define CHUNKS (3 * COEFFICIENTS / LANES)

// For compilers that put several work-items into one vector: these kernels use vectors already. Vectors of 64 Gaussians
// would take Intel's compiler half a minute.
#if LANES == 8
#define VECTORS __attribute__((vec_type_hint(reals)))
#else
#define VECTORS
#endif
#define GROUPED __attribute__((reqd_work_group_size(GROUP, 1, 1)))

// Scales and opacities after their activations.
typedef struct {
    reals3 scales; // world units
    reals opacity;
} Activated;

// Gradients with respect to the parameters and the camera.
typedef struct {
    reals3 mean, log_scales;
    reals4 quat;
    reals logit_opacity;
    reals3 color; // that of coefficient k is basis[k] color
#if CAMERA_GRAD
    mat3 view;
    reals3 translation;
    reals4 intrinsics;
#endif
} GaussianGrad;

#define NUMBERS ((int)(sizeof(GaussianGrad) / sizeof(reals)))

// conic (xx, xy, yy) = inverse of cov2d: v_cov = -Q V Q with the symmetric matrix V of (v_xx, v_xy/2, v_yy).
static inline reals3 conic_vjp(reals3 q, reals3 v) {
    return vector3(-(q.x * q.x * v.x + q.x * q.y * v.y + q.y * q.y * v.z),
                   -(2 * q.x * q.y * v.x + (q.y * q.y + q.x * q.z) * v.y + 2 * q.y * q.z * v.z),
                   -(q.y * q.y * v.x + q.y * q.z * v.y + q.z * q.z * v.z));
}

#if RAYS
#include "gaussian_rays.h"
#else

// Intermediate values for the forward and the backward pass.
typedef struct {
    reals3 p;         // centre, camera frame
    Lens lens;        // J and the depth at the centre
    mat3 rotation;    // of the Gaussian
    reals3 scales;    // standard deviations, world units
    reals3 t0, t1;    // rows of J W
    reals3 b0, b1;    // rows of J W R S: cov2d = B B^T + BLUR I
    reals xx, xy, yy; // cov2d
    reals det0, det;  // determinants of cov2d without and with the blur
} Footprint;

static inline Footprint footprint(const Camera *camera, reals3 mean, reals3 scales, reals4 unit_quat) {
    Footprint f;
    f.p = camera_point(camera, mean);
    f.lens = lens(camera, f.p);
    f.t0 = camera_rotate_back(camera, f.lens.j0);
    f.t1 = camera_rotate_back(camera, f.lens.j1);
    f.rotation = rotation_from_quat(unit_quat);
    f.scales = scales;
    f.b0 = times3(mat3_tmul(&f.rotation, f.t0), f.scales);
    f.b1 = times3(mat3_tmul(&f.rotation, f.t1), f.scales);
    const reals xx = dot3(f.b0, f.b0), yy = dot3(f.b1, f.b1);
    // |b0 x b1|^2 = xx yy - xy^2 (Lagrange), without the cancellation that makes a needle's determinant
    // negative.
    const reals3 normal = cross3(f.b0, f.b1);
    f.det0 = dot3(normal, normal);
    f.det = f.det0 + BLUR * (xx + yy) + BLUR * BLUR;
    f.xx = xx + BLUR;
    f.xy = dot3(f.b0, f.b1);
    f.yy = yy + BLUR;
    return f;
}

// v_cov = (v_xx, v_xy, v_yy): gradients of cov2d, where xy stands for both off-diagonal entries. v->quat receives the
// gradient of the unit quaternion.
static inline void footprint_vjp(const Camera *camera, const Footprint *f, reals3 mean, reals4 unit_quat,
                                 reals3 v_cov, reals2 v_mean2d, reals v_depth, GaussianGrad *v) {
    const reals3 v_b0 = combined3(2 * v_cov.x, f->b0, v_cov.y, f->b1);
    const reals3 v_b1 = combined3(2 * v_cov.z, f->b1, v_cov.y, f->b0);

    // b = S R^T t
    const reals3 scaled0 = times3(f->scales, v_b0), scaled1 = times3(f->scales, v_b1);
    v->log_scales = plus3(times3(f->b0, v_b0), times3(f->b1, v_b1));
    const mat3 v_rotation = mat3_outer2(f->t0, scaled0, f->t1, scaled1);
    v->quat = rotation_from_quat_vjp(unit_quat, &v_rotation);
    const reals3 v_t0 = mat3_mul(&f->rotation, scaled0), v_t1 = mat3_mul(&f->rotation, scaled1);

    // t = W^T j
    const reals3 v_j0 = camera_rotate(camera, v_t0), v_j1 = camera_rotate(camera, v_t1);
    reals4 v_intrinsics;
    const reals3 v_p = lens_vjp(camera, f->p, &f->lens, v_mean2d, v_j0, v_j1, v_depth, &v_intrinsics);

    // p = W mean + translation
    v->mean = camera_rotate_back(camera, v_p);
#if CAMERA_GRAD
    v->intrinsics = v_intrinsics;
    v->translation = v_p;
    v->view = mat3_outer2(f->lens.j0, v_t0, f->lens.j1, v_t1);
    add_outer(v_p, mean, &v->view);
#endif
}

#endif

// Factor on the opacity, and the gradients of the determinants with respect to it.
static inline reals compensation(reals det0, reals det) {
#if ANTIALIASED
    const reals ratio = det0 / det, least = COMPENSATION_MIN * COMPENSATION_MIN;
    return ROOTS(GREATER(ratio, least));
#else
    return 1;
#endif
}

static inline reals2 compensation_vjp(reals det0, reals det, reals v_factor) {
    reals2 v = {0, 0};
#if ANTIALIASED
    const reals ratio = det0 / det, least = COMPENSATION_MIN * COMPENSATION_MIN, zero = 0;
    const reals v_ratio = ratio > least ? v_factor * (real)0.5 / ROOTS(ratio) : zero;
    v.x = v_ratio / det;
    v.y = -v_ratio * ratio / det;
#endif
    return v;
}

// exp(x). Overflow gives infinity, underflow the smallest normal number; NaN stays NaN.
static inline reals exponential(reals x) {
    const reals t = (real)LOG2_E * x, least = POWER_MIN, most = POWER_MAX;
    return t == t ? POWER(CLAMP(t, least, most)) : t;
}

static inline Activated activate(reals3 log_scales, reals logit_opacity) {
    const Activated a = {
        vector3(exponential(log_scales.x), exponential(log_scales.y), exponential(log_scales.z)),
        1 / (1 + exponential(-logit_opacity)),
    };
    return a;
}

// Whether the centre of one of `size` pixels lies in [lo, hi].
static inline masks shows_pixel(reals lo, reals hi, int size) {
    ints first, last;
    pixels_between(lo, hi, size, &first, &last);
    return MASKS_OF(first <= last);
}

// The coefficients k with first <= k < last of the Gaussians from i on: values[3 (k - first) + c] for channel c.
static inline void load_coefficients(const __global real *sh, size_t i, size_t n, int stride, int first, int last,
                                     reals *values) {
#if LANES == 8
    // Without the tests of each chunk: loads go straight to the registers that are transposed.
    if (i + LANES <= n && last - first == COEFFICIENTS) {
        const __global real *row = sh + 3 * (i * stride + first);
#pragma unroll
        for (int k = 0; k < CHUNKS; ++k) {
#pragma unroll
            for (int lane = 0; lane < LANES; ++lane)
                values[LANES * k + lane] = load8(row + 3 * lane * stride + LANES * k);
            transpose(values + LANES * k);
        }
        return;
    }
#endif
    for (int lane = 0; lane < LANES; ++lane) {
        const size_t row = LESSER(i + lane, n - 1) * stride;
        for (int k = 0; k < CHUNKS; ++k)
            load_chunks(sh, 3 * (row + first) + LANES * k, 3 * (row + last), 1, values + LANES * k + lane);
    }
    for (int k = 0; k < CHUNKS; ++k)
        transpose(values + LANES * k);
}

static inline int coefficients_of(int sh_degree) {
    return (sh_degree + 1) * (sh_degree + 1);
}

// Prefetches the first `count` coefficients of the Gaussians of the work-item after the next one.
static inline void fetch_coefficients(const __global real *sh, size_t i, size_t n, int stride, int count) {
#if LANES == 8
    if (i + 3 * LANES > n)
        return;
    for (int lane = 0; lane < LANES; ++lane) {
        const __global real *row = sh + 3 * (i + 2 * LANES + lane) * stride;
        for (int k = 0; k < 3 * count; k += LINE)
            FETCH_TO_READ(row + k);
    }
#endif
}

__kernel VECTORS void project_fwd(const uint n, const Camera camera, const int sh_stride, const int sh_degree,
                                  const __global real *means, const __global real *log_scales,
                                  const __global real *quats, const __global real *logit_opacities,
                                  const __global real *sh, __global real *means2d, __global real *conics,
                                  __global real *depths, __global real *extents, __global real *opacities,
                                  __global real *colors
#if RAYS
                                  ,
                                  __global real *rays, const real gain
#endif
) {
    const size_t i = LANES * get_global_id(0);
    if (i >= n)
        return;

    const int active = coefficients_of(sh_degree);
    fetch_coefficients(sh, i, n, sh_stride, active);
    const reals3 mean = load_vectors3(means, i, n);
    const reals4 quat = load_vectors4(quats, i, n);
    const reals norm2 = dot4(quat, quat), zero = 0;
    const Activated activated = activate(load_vectors3(log_scales, i, n), load_numbers(logit_opacities, i, n));
    const Footprint f = footprint(&camera, mean, activated.scales, normalized4(quat));
    const reals opacity = activated.opacity * compensation(f.det0, f.det);
#if RAYS
    const reals r2 = ellipse_r2(gain * opacity);
    const Outline outline = ray_outline(&camera, &f, r2);
    const reals2 centre = outline.centre, extent = outline.extent;
    const reals3 conic = outline.conic;
#else
    const reals r2 = ellipse_r2(opacity);
    const reals2 centre = lens_centre(&camera, f.p);
    const reals2 extent = {ROOTS(r2 * f.xx), ROOTS(r2 * f.yy)};
    const reals3 conic = vector3(f.yy / f.det, -f.xy / f.det, f.xx / f.det);
#endif
    reals basis[16];
    sh_basis(normalized3(lens_offset(&camera, mean)), sh_degree, basis);
    reals3 color = {(real)0.5, (real)0.5, (real)0.5};
#if LANES == 1
#pragma unroll
#endif
    FOR_COEFFICIENTS(first, active) {
        reals values[3 * COEFFICIENTS];
        const int last = LESSER(first + COEFFICIENTS, active);
        load_coefficients(sh, i, n, sh_stride, first, last, values);
        for (int k = first; k < last; ++k) {
            const reals *c = values + 3 * (k - first);
            color = plus3(color, scaled3(basis[k], vector3(c[0], c[1], c[2])));
        }
    }

    // A sum is not finite if a term is not: one test detects all.
    reals any =
        norm2 + f.det + f.lens.depth + centre.x + centre.y + extent.x + extent.y + color.x + color.y + color.z;
#if RAYS
    any += conic.x + conic.y + conic.z + f.slopes.x + f.slopes.y + f.slopes.z;
#endif
    const masks visible = FINITE(any) & lens_sees(&camera, f.p) & (norm2 >= (reals)QUAT_NORM2_MIN) & (r2 > zero) &
                          shows_pixel(centre.x - extent.x, centre.x + extent.x, camera.width) &
                          shows_pixel(centre.y - extent.y, centre.y + extent.y, camera.height);
#define IF_VISIBLE(x) (visible ? (x) : zero)
    const reals2 shown_centre = {IF_VISIBLE(centre.x), IF_VISIBLE(centre.y)};
    const reals2 shown_extent = {IF_VISIBLE(extent.x), IF_VISIBLE(extent.y)};
    const reals3 shown_color = {IF_VISIBLE(GREATER(color.x, zero)), IF_VISIBLE(GREATER(color.y, zero)),
                                IF_VISIBLE(GREATER(color.z, zero))};
    const reals depth = IF_VISIBLE(f.lens.depth);
    store_vectors2(means2d, i, n, shown_centre);
    store_vectors3(conics, i, n, vector3(IF_VISIBLE(conic.x), IF_VISIBLE(conic.y), IF_VISIBLE(conic.z)));
    store_numbers(depths, i, n, depth);
    store_vectors2(extents, i, n, shown_extent);
    store_numbers(opacities, i, n, IF_VISIBLE(opacity));
#if CHANNELS == 3
    store_vectors3(colors, i, n, shown_color);
#else
    store_vectors4(colors, i, n, vector4(shown_color.x, shown_color.y, shown_color.z, depth));
#endif
#if RAYS
    reals row[RAY_REALS];
    ray_row(&camera, &f, row);
    for (int k = 0; k < RAY_REALS; ++k)
        row[k] = IF_VISIBLE(row[k]);
    transpose(row);
    store_chunks(rays, RAY_REALS * i, RAY_REALS * n, RAY_REALS, row);
#endif
}

#if !RAYS
// Depth of a Gaussian's maximum along the ray of a pixel. In the local affine approximation, depth and image position
// are jointly normal. For a pixel at d from the centre, the maximum is at the conditional mean of the depth,
//   z + g.d,   g = cov2d^-1 (J W Sigma W^T e_z).
// The disparity 1/z of a plane is affine in the image. 1/z - (g/z^2).d has the same value and slope at the centre, and
// is exact for discs (cf. Radl et al. 2024, "StopThePop", equation 10, for the Gaussian without blur).
__kernel VECTORS void project_disparities(const uint n, const Camera camera, const __global real *means,
                                          const __global real *log_scales, const __global real *quats,
                                          const __global real *conics, const __global real *extents,
                                          __global real *disparities) {
    const size_t i = LANES * get_global_id(0);
    if (i >= n)
        return;
    const reals zero = 0;
    const reals2 extent = load_vectors2(extents, i, n);
    const masks visible = extent.x > zero;
    const reals4 quat = load_vectors4(quats, i, n);
    const Footprint f = footprint(&camera, load_vectors3(means, i, n),
                                  activate(load_vectors3(log_scales, i, n), zero).scales, normalized4(quat));
    const reals3 b2 = times3(mat3_tmul(&f.rotation, camera_rotate_back(&camera, f.lens.onward)), f.scales);
    const reals3 conic = load_vectors3(conics, i, n);
    const reals xz = dot3(f.b0, b2), yz = dot3(f.b1, b2), inv_z = 1 / f.lens.depth;
    const reals slope_x = -inv_z * inv_z * (conic.x * xz + conic.y * yz);
    const reals slope_y = -inv_z * inv_z * (conic.y * xz + conic.z * yz);
    // Disparities that are not finite at some pixel have no order.
    const reals most = slope_x * extent.x + slope_y * extent.y;
    const masks finite = visible & FINITE(most);
    store_vectors3(disparities, i, n, vector3(IF_VISIBLE(inv_z), finite ? slope_x : zero, finite ? slope_y : zero));
}
#endif

typedef struct {
    const __global real *means, *log_scales, *quats, *logit_opacities, *sh;
} GaussianArrays;

typedef struct {
    const __global real *conics, *extents, *colors, *v_means2d, *v_conics;
#if RAYS
    const __global real *v_slopes;
#endif
    const __global real *v_opacities, *v_colors;
} SplatArrays;

// Gradients of the Gaussians from i on, and the basis of their spherical harmonics; 0 for those that are not visible.
INLINED GaussianGrad gaussian_vjp(size_t i, size_t n, const Camera *camera, int sh_stride, int sh_degree,
                                  GaussianArrays gaussians, SplatArrays splats, reals *basis) {
    GaussianGrad v = {0};
    for (int k = 0; k < 16; ++k)
        basis[k] = 0;
    const reals zero = 0;
    const masks visible = i < n ? load_vectors2(splats.extents, i, n).x > zero : (masks)0;
    if (!any_lane(visible))
        return v;

    const reals3 mean = load_vectors3(gaussians.means, i, n);
    const reals4 quat = load_vectors4(gaussians.quats, i, n);
    const reals4 unit_quat = normalized4(quat);
    const Activated activated =
        activate(load_vectors3(gaussians.log_scales, i, n), load_numbers(gaussians.logit_opacities, i, n));
    const Footprint f = footprint(camera, mean, activated.scales, unit_quat);

    const reals opacity = activated.opacity, factor = compensation(f.det0, f.det);
    const reals v_opacity = load_numbers(splats.v_opacities, i, n);
    v.logit_opacity = v_opacity * factor * opacity * (1 - opacity);
    const reals2 v_det = compensation_vjp(f.det0, f.det, v_opacity * opacity);
#if RAYS
    const reals3 v_conic = load_vectors3(splats.v_conics, i, n), v_slopes = load_vectors3(splats.v_slopes, i, n);
#else
    reals3 v_cov = conic_vjp(load_vectors3(splats.conics, i, n), load_vectors3(splats.v_conics, i, n));
    v_cov.x += v_det.x * (f.yy - BLUR) + v_det.y * f.yy;
    v_cov.y += -2 * f.xy * (v_det.x + v_det.y);
    v_cov.z += v_det.x * (f.xx - BLUR) + v_det.y * f.xx;
#endif

    // A colour that is clamped at 0 has the gradient 0.
#if CHANNELS == 3
    const reals3 color = load_vectors3(splats.colors, i, n), v_color = load_vectors3(splats.v_colors, i, n);
    const reals v_depth = 0;
#else
    const reals4 color = load_vectors4(splats.colors, i, n), v_color = load_vectors4(splats.v_colors, i, n);
    const reals v_depth = v_color.w;
#endif
    v.color = vector3(color.x > zero ? v_color.x : zero, color.y > zero ? v_color.y : zero,
                      color.z > zero ? v_color.z : zero);
    const reals2 v_mean2d = load_vectors2(splats.v_means2d, i, n);
#if RAYS
    footprint_vjp(camera, &f, mean, unit_quat, v_conic, v_slopes, v_det, v_mean2d, v_depth, &v);
#else
    footprint_vjp(camera, &f, mean, unit_quat, v_cov, v_mean2d, v_depth, &v);
#endif
    v.quat = normalize_quat_vjp(quat, v.quat);

    const reals3 offset = lens_offset(camera, mean), direction = normalized3(offset);
    reals v_basis[16];
    sh_basis(direction, sh_degree, basis);
    const int active = coefficients_of(sh_degree);
#if LANES == 1
#pragma unroll
#endif
    FOR_COEFFICIENTS(first, active) {
        reals values[3 * COEFFICIENTS];
        const int last = LESSER(first + COEFFICIENTS, active);
        load_coefficients(gaussians.sh, i, n, sh_stride, first, last, values);
        for (int k = first; k < last; ++k) {
            const reals *c = values + 3 * (k - first);
            v_basis[k] = dot3(vector3(c[0], c[1], c[2]), v.color);
        }
    }
    const reals3 v_offset = normalize_vjp(offset, sh_basis_vjp(direction, sh_degree, v_basis));
#if LENS == ORTHOGRAPHIC
#if CAMERA_GRAD
    v.view.row2 = plus3(v.view.row2, v_offset);
#endif
#else
    v.mean = plus3(v.mean, v_offset);
#if CAMERA_GRAD
    // position = -W^-1 translation: v_translation = W v_offset, v_W = (W v_offset) position^T
    const reals3 v_translation = camera_rotate(camera, v_offset);
    v.translation = plus3(v.translation, v_translation);
    add_outer(v_translation, vector3(camera->position[0], camera->position[1], camera->position[2]), &v.view);
#endif
#endif

    // Gradients that overflow would make Adam's moments NaN permanently: they are set to 0 for this view.
    reals *numbers = (reals *)&v, any = 0;
    for (int k = 0; k < NUMBERS; ++k)
        any += numbers[k];
    const masks kept = visible & FINITE(any);
    for (int k = 0; k < NUMBERS; ++k)
        numbers[k] = kept ? numbers[k] : zero;
    for (int k = 0; k < 16; ++k)
        basis[k] = kept ? basis[k] : zero;
    return v;
}

#if CAMERA_GRAD
// Adds up the camera's gradient over the work-group, in the order of its work-items.
static inline void sum_camera(const GaussianGrad *v, __local real *partial, __global real *v_camera) {
    const uint item = get_local_id(0);
    const reals *of_camera = (const reals *)&v->view; // followed by translation and intrinsics
    for (int k = 0; k < 16; ++k)
        partial[16 * item + k] = lane_sum(of_camera[k]);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = item; k < 16; k += GROUP) {
        real sum = 0;
        for (uint j = 0; j < GROUP; ++j)
            sum += partial[16 * j + k];
        v_camera[16 * get_group_id(0) + k] = sum;
    }
}
#endif

#if LANES == 1
// Factors of the gradients of a Gaussian's coefficients, in local memory: the basis, then the gradient of the colour.
// The number of values is odd, so that the rows of neighbouring work-items begin in different banks.
#define ROW 19

static inline void share_row(const real *basis, reals3 v_color, __local real *rows) {
    __local real *row = rows + ROW * get_local_id(0);
#pragma unroll
    for (int k = 0; k < 16; ++k)
        row[k] = basis[k];
    row[16] = v_color.x;
    row[17] = v_color.y;
    row[18] = v_color.z;
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE); // the coefficients are read before others change them
}

// A number of a group's coefficients: that of its Gaussian in the group, and its own in the Gaussian's row.
typedef struct {
    uint gaussian, number;
} Place;

// The place GROUP numbers behind, if rows have `width` numbers.
static inline Place place_after(Place place, uint width) {
    Place next = {place.gaussian + GROUP / width, place.number + GROUP % width};
    if (next.number >= width) {
        next.number -= width;
        ++next.gaussian;
    }
    return next;
}

static inline real coefficient_grad(const __local real *rows, Place place) {
    const __local real *row = rows + ROW * place.gaussian;
    return row[place.number / 3] * row[16 + place.number % 3];
}
#else
// Gradients of the coefficients from `first` on, in chunks: values[LANES k + lane] is the k-th chunk of a Gaussian.
static inline void coefficients_grad(const reals *basis, reals3 v_color, int first, reals *values) {
    for (int k = 0; k < COEFFICIENTS; ++k) {
        const reals3 v = scaled3(basis[first + k], v_color);
        values[3 * k] = v.x;
        values[3 * k + 1] = v.y;
        values[3 * k + 2] = v.z;
    }
    for (int k = 0; k < CHUNKS; ++k)
        transpose(values + LANES * k);
}
#endif

__kernel VECTORS GROUPED void
project_bwd(const uint n, const Camera camera, const int sh_stride, const int sh_degree, const __global real *means,
            const __global real *log_scales, const __global real *quats, const __global real *logit_opacities,
            const __global real *sh, const __global real *conics, const __global real *extents,
            const __global real *colors, const __global real *v_means2d, const __global real *v_conics,
#if RAYS
            const __global real *v_slopes,
#endif
            const __global real *v_opacities, const __global real *v_colors, __global real *v_means,
            __global real *v_log_scales, __global real *v_quats, __global real *v_logit_opacities, __global real *v_sh
#if CAMERA_GRAD
            ,
            __global real *v_camera
#endif
) {
    const size_t i = LANES * get_global_id(0);
    const GaussianArrays gaussians = {means, log_scales, quats, logit_opacities, sh};
    const SplatArrays splats = {
        conics,
        extents,
        colors,
        v_means2d,
        v_conics,
#if RAYS
        v_slopes,
#endif
        v_opacities,
        v_colors
    };
    reals basis[16];
    const GaussianGrad v = gaussian_vjp(i, n, &camera, sh_stride, sh_degree, gaussians, splats, basis);
#if CAMERA_GRAD
    __local real partial[16 * GROUP];
    sum_camera(&v, partial, v_camera);
#endif
#if LANES == 1
    __local real rows[ROW * GROUP];
    share_row(basis, v.color, rows);
    const uint first_row = GROUP * get_group_id(0), width = 3 * sh_stride;
    const uint count = min((uint)GROUP, n - first_row) * width;
    Place place = {get_local_id(0) / width, get_local_id(0) % width};
    for (uint k = get_local_id(0); k < count; k += GROUP, place = place_after(place, width))
        v_sh[(size_t)first_row * width + k] = coefficient_grad(rows, place);
#endif
    if (i >= n)
        return;
    store_vectors3(v_means, i, n, v.mean);
    store_vectors3(v_log_scales, i, n, v.log_scales);
    store_vectors4(v_quats, i, n, v.quat);
    store_numbers(v_logit_opacities, i, n, v.logit_opacity);
#if LANES == 8
    FOR_COEFFICIENTS(first, sh_stride) {
        reals values[3 * COEFFICIENTS];
        coefficients_grad(basis, v.color, first, values);
        for (int lane = 0; lane < LANES && i + lane < n; ++lane) {
            const size_t row = (i + lane) * sh_stride;
            for (int k = 0; k < CHUNKS; ++k)
                store_chunks(v_sh, 3 * (row + first) + LANES * k, 3 * (row + sh_stride), 1,
                             values + LANES * k + lane);
        }
    }
#endif
}

DEFINE_ADAM()
#if LANES == 8
DEFINE_ADAM(8)
#endif

typedef struct {
    __global real *parameters, *first, *second;
} AdamArrays;

#if LANES == 8
static inline void update_whole_chunk(const Adam *adam, reals rates, reals g, size_t begin, AdamArrays a) {
    reals m = load8(a.first + begin), v = load8(a.second + begin);
    store8(a.parameters + begin, adam_update8(adam, rates, load8(a.parameters + begin), g, &m, &v));
    store8(a.first + begin, m);
    store8(a.second + begin, v);
}
#endif

// Updates a chunk of adjacent parameters from `begin` on. Those from `end` on are left as they are.
static inline void update_chunk(const Adam *adam, reals rates, reals g, size_t begin, size_t end, AdamArrays a) {
#if LANES == 8
    if (begin + LANES <= end) {
        update_whole_chunk(adam, rates, g, begin, a);
        return;
    }
#endif
    for (size_t i = begin; i < LESSER(begin + LANES, end); ++i) {
        real m = a.first[i], v = a.second[i];
        a.parameters[i] = adam_update(adam, LANE(rates, i - begin), a.parameters[i], LANE(g, i - begin), &m, &v);
        a.first[i] = m;
        a.second[i] = v;
    }
}

// Updates the `count` parameters of each Gaussian from i on; g: their gradients, in chunks.
static inline void update_chunks(const Adam *adam, real rate, const reals *g, int count, size_t i, size_t n,
                                 AdamArrays a) {
    fetch_ahead(a.first + count * i, count);
    fetch_ahead(a.second + count * i, count);
#pragma unroll
    for (int k = 0; k < count; ++k)
        update_chunk(adam, rate, g[k], count * i + LANES * k, count * n, a);
}

static inline void update_vectors3(const Adam *adam, real rate, reals3 g, size_t i, size_t n, AdamArrays a) {
    reals c[3];
    scattered3(g, c);
    update_chunks(adam, rate, c, 3, i, n, a);
}

#if LANES == 1
// Number of values that a work-item loads before it stores the first of them, so that their latencies overlap.
#define OVERLAPPED 4

// Updates the first `active` coefficients of all Gaussians of the group.
static inline void update_coefficients(const Adam *adam, const __local real *rows, uint n, int sh_stride, int active,
                                       AdamArrays a) {
    const uint first_row = GROUP * get_group_id(0), width = 3 * active;
    const uint count = min((uint)GROUP, n - first_row) * width;
    Place place = {get_local_id(0) / width, get_local_id(0) % width};
    for (uint k = get_local_id(0); k < count; k += OVERLAPPED * GROUP) {
        real p[OVERLAPPED], m[OVERLAPPED], v[OVERLAPPED], g[OVERLAPPED], rates[OVERLAPPED];
        size_t at[OVERLAPPED];
#pragma unroll
        for (int o = 0; o < OVERLAPPED; ++o) {
            if (k + o * GROUP < count) {
                at[o] = (size_t)(first_row + place.gaussian) * (3 * sh_stride) + place.number;
                p[o] = a.parameters[at[o]];
                m[o] = a.first[at[o]];
                v[o] = a.second[at[o]];
                g[o] = coefficient_grad(rows, place);
                rates[o] = place.number < 3 ? adam->sh0 : adam->sh_rest;
            }
            place = place_after(place, width);
        }
#pragma unroll
        for (int o = 0; o < OVERLAPPED; ++o) {
            if (k + o * GROUP < count) {
                a.parameters[at[o]] = adam_update(adam, rates[o], p[o], g[o], &m[o], &v[o]);
                a.first[at[o]] = m[o];
                a.second[at[o]] = v[o];
            }
        }
    }
}
#endif

// project_bwd and the step of Adam (adam.cl) in one pass, with the gradients in registers or in local memory.
__kernel VECTORS GROUPED void
project_bwd_adam(const uint n, const Camera camera, const int sh_stride, const int sh_degree, const Adam adam,
                 __global real *means, __global real *log_scales, __global real *quats,
                 __global real *logit_opacities, __global real *sh, __global real *means_1,
                 __global real *log_scales_1, __global real *quats_1, __global real *logit_opacities_1,
                 __global real *sh_1, __global real *means_2, __global real *log_scales_2, __global real *quats_2,
                 __global real *logit_opacities_2, __global real *sh_2, const __global real *conics,
                 const __global real *extents, const __global real *colors, const __global real *v_means2d,
                 const __global real *v_conics,
#if RAYS
                 const __global real *v_slopes,
#endif
                 const __global real *v_opacities, const __global real *v_colors
#if CAMERA_GRAD
                 ,
                 __global real *v_camera
#endif
) {
    const size_t i = LANES * get_global_id(0);
    const GaussianArrays gaussians = {means, log_scales, quats, logit_opacities, sh};
    const SplatArrays splats = {
        conics,
        extents,
        colors,
        v_means2d,
        v_conics,
#if RAYS
        v_slopes,
#endif
        v_opacities,
        v_colors
    };
    const int active = coefficients_of(sh_degree);
    fetch_coefficients(sh, i, n, sh_stride, active);
    fetch_coefficients(sh_1, i, n, sh_stride, active);
    fetch_coefficients(sh_2, i, n, sh_stride, active);
    reals basis[16];
    GaussianGrad v = gaussian_vjp(i, n, &camera, sh_stride, sh_degree, gaussians, splats, basis);
#if CAMERA_GRAD
    __local real partial[16 * GROUP];
    sum_camera(&v, partial, v_camera);
#endif
    const AdamArrays of_sh = {sh, sh_1, sh_2};
#if LANES == 1
    __local real rows[ROW * GROUP];
    share_row(basis, v.color, rows);
    update_coefficients(&adam, rows, n, sh_stride, active, of_sh);
#endif
    if (i >= n)
        return;
    // Gaussians that are not shown have no penalties: they would fade before a photo shows them.
    if (adam.opacity_penalty != 0 || adam.scale_penalty != 0) {
        const Activated activated = activate(load_vectors3(log_scales, i, n), load_numbers(logit_opacities, i, n));
        const reals3 of_scales = scaled3(adam.scale_penalty, activated.scales);
        const reals zero = 0;
        const masks shown = load_vectors2(extents, i, n).x > zero;
        v.logit_opacity += shown ? adam.opacity_penalty * activated.opacity * (1 - activated.opacity) : zero;
        v.log_scales.x += shown ? of_scales.x : zero;
        v.log_scales.y += shown ? of_scales.y : zero;
        v.log_scales.z += shown ? of_scales.z : zero;
    }
    if (adam.erank_penalty != 0) {
        for (int lane = 0; lane < LANES && i + lane < n; ++lane) {
            if (!(extents[2 * (i + lane)] > 0))
                continue;
            const real3 penalty = adam.erank_penalty * erank_vjp(load3(log_scales, i + lane), adam.erank_slack);
            ((real *)&v.log_scales.x)[lane] += penalty.x;
            ((real *)&v.log_scales.y)[lane] += penalty.y;
            ((real *)&v.log_scales.z)[lane] += penalty.z;
        }
    }

    const AdamArrays of_means = {means, means_1, means_2}, of_scales = {log_scales, log_scales_1, log_scales_2};
    const AdamArrays of_quats = {quats, quats_1, quats_2};
    const AdamArrays of_opacities = {logit_opacities, logit_opacities_1, logit_opacities_2};
    update_vectors3(&adam, adam.means, v.mean, i, n, of_means);
    update_vectors3(&adam, adam.log_scales, v.log_scales, i, n, of_scales);
    reals quat[4];
    scattered4(v.quat, quat);
    update_chunks(&adam, adam.quats, quat, 4, i, n, of_quats);
    update_chunks(&adam, adam.logit_opacities, &v.logit_opacity, 1, i, n, of_opacities);

#if LANES == 8
    const reals sh0 = adam.sh0, sh_rest = adam.sh_rest;
    FOR_COEFFICIENTS(first, active) {
        reals values[3 * COEFFICIENTS];
        coefficients_grad(basis, v.color, first, values);
        if (i + LANES <= n && first + COEFFICIENTS <= active) {
            for (int lane = 0; lane < LANES; ++lane) {
                const size_t begin = 3 * ((i + lane) * sh_stride + first);
                for (int k = 0; k < CHUNKS; ++k) {
                    const reals number = LANE_NUMBERS + (3 * first + LANES * k);
                    update_whole_chunk(&adam, number < 3 ? sh0 : sh_rest, values[LANES * k + lane], begin + LANES * k,
                                       of_sh);
                }
            }
            continue;
        }
        for (int lane = 0; lane < LANES && i + lane < n; ++lane) {
            const size_t row = (i + lane) * sh_stride;
            for (int k = 0; k < CHUNKS; ++k) {
                const reals number = LANE_NUMBERS + (3 * first + LANES * k);
                update_chunk(&adam, number < 3 ? sh0 : sh_rest, values[LANES * k + lane],
                             3 * (row + first) + LANES * k, 3 * (row + active), of_sh);
            }
        }
    }
#endif
}
