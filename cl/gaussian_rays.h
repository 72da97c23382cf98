// Gaussians along rays: the shape of a splat without the affine approximation, its outline, and the gradients.
//
// For the ray from the camera in direction d, the density of a Gaussian is largest where its squared distance from the
// centre, in standard deviations, is D^2 = |w x u|^2/|u|^2 with w = L^-1 p and u = L^-1 d, Sigma = L L^T (3DGEER, Huang
// et al. 2026, equation 8). sigma = D^2/2. In an image chart, in which dx and dy are linear in d and 0 at the centre,
//   D^2 = q/(lambda^2 + k q),   q = (dx, dy) Q (dx, dy)^T,   lambda = along + l_x dx + l_y dy.
// Q is the inverse of the covariance C of (dx, dy), as in the affine projection. l = -Q c is the slope of the
// disparity over the plane in which the Gaussian is largest, with the covariance c of (dx, dy) and depth/z. The variance
// along the ray to the centre is k = var(depth/z) - c^T Q c = 1/|w|^2. All three follow from three vectors,
//   b_i = S R^T W^T j_i,   C = (b_0.b_0, b_0.b_1, b_1.b_1),   c = (b_0.b_2, b_1.b_2),   var(depth/z) = b_2.b_2.
// docs/stages/project.md derives them; clsplat/reference/gaussian_rays.py is the twin.
//
// The chart of a PINHOLE is its image, with d = (.., .., 1) and along = 1. For other lenses, each Gaussian has a chart
// of its own: the image of a pinhole that looks at it, with the axes `frame` and the focal length sqrt(fx fy). d has the
// length 1, and along is the cosine of its angle from the Gaussian. sigma does not depend on the chart, so it has no
// gradient with respect to `frame`.
//
// The blur is in three dimensions, so that edge-on discs stay thin Gaussians: S^2 = scales^2 + BLUR depth^2/(fx fy).
#ifndef CLSPLAT_GAUSSIAN_RAYS_H
#define CLSPLAT_GAUSSIAN_RAYS_H

// Terms of a Gaussian along rays: centre in the chart (0 for a chart of its own), Q (xx, xy, yy), l, k; and, for a chart
// of its own, the three axes, with dx = d.axis0, dy = d.axis1 and along = d.axis2.
#if LENS == PINHOLE
#define RAY_REALS 8
#else
#define RAY_REALS 17
#endif

// Intermediate values for the forward and the backward pass.
typedef struct {
    reals3 p;            // centre, camera frame
    Lens lens;           // rows j_0, j_1 and the depth
    reals3 j2;           // row j_2
    mat3 frame;          // axes of the chart, camera frame
    reals focal;         // focal length of the chart, px
    mat3 rotation;       // of the Gaussian
    reals3 kept, scales; // scales^2/S^2, S
    reals blur;          // variance of the blur, squared world units
    reals3 t0, t1, t2;   // W^T j_i
    reals3 b0, b1, b2;
    reals3 normal;    // b_0 x b_1
    reals xx, xy, yy; // C
    reals xz, yz, zz; // c, var(depth/z)
    reals det0, det;  // determinants of C without and with the blur
    reals3 conic;     // Q (xx, xy, yy)
    reals3 slopes;    // l_x, l_y, k
} Footprint;

#if LENS != PINHOLE
// Orthonormal axes, the last of which is the unit vector n (Duff et al. 2017, "Building an Orthonormal Basis,
// Revisited", listing 3).
static inline mat3 axes_around(reals3 n) {
    const real sign = n.z < 0 ? -1 : 1, a = -1 / (sign + n.z), b = n.x * n.y * a;
    const mat3 axes = {vector3(1 + sign * n.x * n.x * a, sign * b, -sign * n.x),
                       vector3(b, sign + n.y * n.y * a, -n.y), n};
    return axes;
}
#endif

// Components without the blur: the scales are smaller by sqrt(kept).
static inline reals3 unblurred(const Footprint *f, reals3 b) {
    return vector3(b.x * ROOTS(f->kept.x), b.y * ROOTS(f->kept.y), b.z * ROOTS(f->kept.z));
}

static inline Footprint footprint(const Camera *camera, reals3 mean, reals3 scales, reals4 unit_quat) {
    Footprint f;
    f.p = camera_point(camera, mean);
#if LENS == PINHOLE
    const reals inv_z = 1 / f.p.z;
    f.lens.depth = f.p.z;
    f.lens.j0 = vector3(camera->fx * inv_z, 0, -camera->fx * f.p.x * inv_z * inv_z);
    f.lens.j1 = vector3(0, camera->fy * inv_z, -camera->fy * f.p.y * inv_z * inv_z);
    f.j2 = vector3(0, 0, inv_z);
#else
    f.lens.depth = sqrt(dot3(f.p, f.p));
    const real inv_z = 1 / f.lens.depth;
    f.frame = axes_around(scaled3(inv_z, f.p));
    f.focal = sqrt(camera->fx * camera->fy);
    f.lens.j0 = scaled3(f.focal * inv_z, f.frame.row0);
    f.lens.j1 = scaled3(f.focal * inv_z, f.frame.row1);
    f.j2 = scaled3(inv_z, f.frame.row2);
#endif
    const reals3 squares = times3(scales, scales);
    f.blur = (real)BLUR * f.lens.depth * f.lens.depth / (camera->fx * camera->fy);
    const reals3 wider = vector3(squares.x + f.blur, squares.y + f.blur, squares.z + f.blur);
    f.kept = vector3(squares.x / wider.x, squares.y / wider.y, squares.z / wider.z);
    f.scales = vector3(ROOTS(wider.x), ROOTS(wider.y), ROOTS(wider.z));
    f.rotation = rotation_from_quat(unit_quat);
    f.t0 = camera_rotate_back(camera, f.lens.j0);
    f.t1 = camera_rotate_back(camera, f.lens.j1);
    f.t2 = camera_rotate_back(camera, f.j2);
    f.b0 = times3(mat3_tmul(&f.rotation, f.t0), f.scales);
    f.b1 = times3(mat3_tmul(&f.rotation, f.t1), f.scales);
    f.b2 = times3(mat3_tmul(&f.rotation, f.t2), f.scales);
    // Determinants by Lagrange's identity: all terms are products of vectors, without differences of squares.
    f.normal = cross3(f.b0, f.b1);
    f.det = dot3(f.normal, f.normal);
    const reals3 normal0 = cross3(unblurred(&f, f.b0), unblurred(&f, f.b1));
    f.det0 = dot3(normal0, normal0);
    f.xx = dot3(f.b0, f.b0);
    f.xy = dot3(f.b0, f.b1);
    f.yy = dot3(f.b1, f.b1);
    f.xz = dot3(f.b0, f.b2);
    f.yz = dot3(f.b1, f.b2);
    f.zz = dot3(f.b2, f.b2);
    f.conic = vector3(f.yy / f.det, -f.xy / f.det, f.xx / f.det);
    const reals volume = dot3(f.normal, f.b2);
    f.slopes = vector3(-dot3(cross3(f.b1, f.normal), f.b2) / f.det, -dot3(cross3(f.normal, f.b0), f.b2) / f.det,
                       volume * volume / f.det);
    return f;
}

// Gradients of the Gaussian and the camera. v_det: with respect to det0 and det.
static inline void footprint_vjp(const Camera *camera, const Footprint *f, reals3 mean, reals4 unit_quat,
                                 reals3 v_conic, reals3 v_slopes, reals2 v_det, reals2 v_mean2d, reals v_depth,
                                 GaussianGrad *v) {
    // Q = C^-1, l = -Q c, k = var - c Q c: dl = -Q (dc + dC l), dk = dvar + 2 l dc + l dC l.
    const reals gx = f->conic.x * v_slopes.x + f->conic.y * v_slopes.y,
                gy = f->conic.y * v_slopes.x + f->conic.z * v_slopes.y;
    const reals lx = f->slopes.x, ly = f->slopes.y, v_k = v_slopes.z;
    reals3 v_cov = conic_vjp(f->conic, v_conic);
    v_cov.x += lx * (v_k * lx - gx);
    v_cov.y += 2 * v_k * lx * ly - gx * ly - gy * lx;
    v_cov.z += ly * (v_k * ly - gy);
    const reals v_xz = 2 * v_k * lx - gx, v_yz = 2 * v_k * ly - gy;

    reals3 v_b0 = plus3(combined3(2 * v_cov.x, f->b0, v_cov.y, f->b1), scaled3(v_xz, f->b2));
    reals3 v_b1 = plus3(combined3(2 * v_cov.z, f->b1, v_cov.y, f->b0), scaled3(v_yz, f->b2));
    const reals3 v_b2 = plus3(combined3(v_xz, f->b0, v_yz, f->b1), scaled3(2 * v_k, f->b2));
    // |n|^2 with n = b_0 x b_1
    v_b0 = plus3(v_b0, scaled3(2 * v_det.y, cross3(f->b1, f->normal)));
    v_b1 = plus3(v_b1, scaled3(2 * v_det.y, cross3(f->normal, f->b0)));
    const reals3 c0 = unblurred(f, f->b0), c1 = unblurred(f, f->b1), normal0 = cross3(c0, c1);
    const reals3 v_c0 = scaled3(2 * v_det.x, cross3(c1, normal0)), v_c1 = scaled3(2 * v_det.x, cross3(normal0, c0));

    // b = S R^T t with S^2 = scales^2 + blur
    const reals3 grown = plus3(plus3(times3(f->b0, v_b0), times3(f->b1, v_b1)), times3(f->b2, v_b2));
    v->log_scales = plus3(times3(f->kept, grown), plus3(times3(c0, v_c0), times3(c1, v_c1)));
    const reals v_blur = (real)0.5 * (grown.x / (f->scales.x * f->scales.x) + grown.y / (f->scales.y * f->scales.y) +
                                      grown.z / (f->scales.z * f->scales.z));
    const reals3 scaled0 = times3(f->scales, plus3(v_b0, unblurred(f, v_c0))),
                 scaled1 = times3(f->scales, plus3(v_b1, unblurred(f, v_c1))), scaled2 = times3(f->scales, v_b2);
    mat3 v_rotation = mat3_outer2(f->t0, scaled0, f->t1, scaled1);
    add_outer(f->t2, scaled2, &v_rotation);
    v->quat = rotation_from_quat_vjp(unit_quat, &v_rotation);
    const reals3 v_t0 = mat3_mul(&f->rotation, scaled0), v_t1 = mat3_mul(&f->rotation, scaled1),
                 v_t2 = mat3_mul(&f->rotation, scaled2);

    // t = W^T j
    reals3 v_j0 = camera_rotate(camera, v_t0), v_j1 = camera_rotate(camera, v_t1), v_j2 = camera_rotate(camera, v_t2);
    const reals z = f->lens.depth, inv_z = 1 / z;
    v_depth += 2 * v_blur * f->blur * inv_z;
#if LENS == PINHOLE
    const reals x = f->p.x * inv_z, y = f->p.y * inv_z;
    const real fx = camera->fx, fy = camera->fy;
    const reals v_x = fx * (v_mean2d.x - inv_z * v_j0.z), v_y = fy * (v_mean2d.y - inv_z * v_j1.z);
    const reals3 v_p =
        vector3(v_x * inv_z, v_y * inv_z,
                v_depth - (v_x * x + v_y * y) * inv_z -
                    inv_z * inv_z * (fx * (v_j0.x - x * v_j0.z) + fy * (v_j1.y - y * v_j1.z) + v_j2.z));
#else
    // At the centre of the chart, x = y = 0.
    v_j0 = mat3_mul(&f->frame, v_j0);
    v_j1 = mat3_mul(&f->frame, v_j1);
    v_j2 = mat3_mul(&f->frame, v_j2);
    const real scale = f->focal * inv_z;
    const reals3 v_p =
        mat3_tmul(&f->frame, vector3(scale * (v_mean2d.x - inv_z * v_j0.z), scale * (v_mean2d.y - inv_z * v_j1.z),
                                     v_depth - inv_z * (scale * (v_j0.x + v_j1.y) + inv_z * v_j2.z)));
#endif

    // p = W mean + translation
    v->mean = camera_rotate_back(camera, v_p);
#if CAMERA_GRAD
#if LENS == PINHOLE
    const reals v_area = v_blur * f->blur;
    v->intrinsics = vector4(v_mean2d.x * x + (dot3(v_j0, f->lens.j0) - v_area) / fx,
                            v_mean2d.y * y + (dot3(v_j1, f->lens.j1) - v_area) / fy, v_mean2d.x, v_mean2d.y);
#endif
    v->translation = v_p;
    v->view = mat3_outer2(f->lens.j0, v_t0, f->lens.j1, v_t1);
    add_outer(f->j2, v_t2, &v->view);
    add_outer(v_p, mean, &v->view);
#endif
}

static inline void ray_row(const Camera *camera, const Footprint *f, reals *row) {
#if LENS == PINHOLE
    const reals2 centre = lens_centre(camera, f->p);
    row[0] = centre.x;
    row[1] = centre.y;
#else
    row[0] = row[1] = 0;
    scattered3(scaled3(f->focal, f->frame.row0), row + 8);
    scattered3(scaled3(f->focal, f->frame.row1), row + 11);
    scattered3(f->frame.row2, row + 14);
#endif
    row[2] = f->conic.x;
    row[3] = f->conic.y;
    row[4] = f->conic.z;
    row[5] = f->slopes.x;
    row[6] = f->slopes.y;
    row[7] = f->slopes.z;
}

// The region of the image in which a splat may be visible: the ellipse of `conic` with r2 around `centre`, or, if the
// conic is 0, the whole box with the half widths `extent`.
typedef struct {
    reals2 centre, extent; // px
    reals3 conic;          // px^-2
} Outline;

#if LENS == PINHOLE

// Range of dx in which D^2 <= r2: dx^2 (1 - r2 zz) + 2 r2 xz dx - r2 xx <= 0, the shadow of the ellipsoid as seen from
// the camera. If the ellipsoid reaches the plane of the camera (open <= 0), it has no end on one side, or on none.
static inline reals2 shadow(reals r2, reals open, reals xx, reals xz) {
    const reals zero = 0, beyond = (real)1e30;
    const reals lean = r2 * (xz < zero ? -xz : xz), square = lean * lean + open * r2 * xx;
    const reals reach = lean + ROOTS(GREATER(square, zero));
    const reals near = square < zero ? beyond : r2 * xx / reach;
    const reals far = open > zero ? reach / open : beyond;
    const reals2 range = {xz < zero ? -near : -far, xz < zero ? far : near};
    return range;
}

// The box from `lo` to `hi`, cut off a pixel outside the image.
static inline reals2 box_within(reals lo, reals hi, real size) {
    const reals least = -1, most = size + 1;
    lo = GREATER(lo, least);
    hi = LESSER(hi, most);
    const reals2 box = {(real)0.5 * (lo + hi), (real)0.5 * (hi - lo)};
    return box;
}

// Largest fraction of the depth that the ellipsoid may reach for its outline to be an ellipse. Beyond it the ellipse
// is so long that its numbers lose their digits, and a box is used.
#define OPEN_MIN ((real)0.05)

static inline Outline ray_outline(const Camera *camera, const Footprint *f, reals r2) {
    const reals zero = 0, open = 1 - r2 * f->zz, inv = 1 / open;
    const reals2 centre = lens_centre(camera, f->p);
    const reals2 across = shadow(r2, open, f->xx, f->xz), along = shadow(r2, open, f->yy, f->yz);
    const reals2 box_x = box_within(centre.x + across.x, centre.x + across.y, camera->width),
                 box_y = box_within(centre.y + along.x, centre.y + along.y, camera->height);
    const reals dx = -r2 * f->xz * inv, dy = -r2 * f->yz * inv;
    const reals xx = f->xx * inv + dx * dx / r2, xy = f->xy * inv + dx * dy / r2, yy = f->yy * inv + dy * dy / r2;
    const reals det = inv * (f->det * inv + (f->yy * dx * dx - 2 * f->xy * dx * dy + f->xx * dy * dy) / r2);
    const masks closed = open > (reals)OPEN_MIN;
    const reals2 middle = {closed ? centre.x + dx : box_x.x, closed ? centre.y + dy : box_y.x};
    const reals2 extent = {closed ? ROOTS(r2 * xx) : box_x.y, closed ? ROOTS(r2 * yy) : box_y.y};
    const Outline outline = {middle, extent,
                             vector3(closed ? yy / det : zero, closed ? -xy / det : zero, closed ? xx / det : zero)};
    return outline;
}

#else

// Points on the border of the cone of rays with D^2 <= r2, through which the outline goes.
#define BORDER        8
#define TURN          ((real)6.283185307179586)
// Growth of these points' cone, so that the polygon contains the cone: 1/cos(TURN/(2 BORDER)).
#define CIRCUMSCRIBED ((real)1.0824)
// Cosine of the largest angle between a Gaussian and its border at which the outline is less than the whole image.
#define WIDE_COS      ((real)0.825)

static inline Outline whole_image(const Camera *camera) {
    const Outline outline = {{(real)0.5 * camera->width, (real)0.5 * camera->height},
                             {(real)0.5 * camera->width + 1, (real)0.5 * camera->height + 1},
                             {0, 0, 0}};
    return outline;
}

// The box of the cone's images. In the space in which the Gaussian is a unit ball, the cone is circular around w, with
// sin^2 = r2/|w|^2. Its border bends between two points: the box grows by the cone's angle.
static inline Outline ray_outline(const Camera *camera, const Footprint *f, reals r2) {
    const real3 inv = 1 / (real3)(f->scales.x, f->scales.y, f->scales.z);
    const reals3 p = mat3_tmul(&f->rotation, camera_rotate_back(camera, f->p));
    const reals3 w = vector3(p.x * inv.x, p.y * inv.y, p.z * inv.z);
    const real square = dot3(w, w);
    if (!(r2 < (real)0.9 * square))
        return whole_image(camera);
    const real widths = CIRCUMSCRIBED * sqrt(r2 / (square - r2));
    const mat3 around = axes_around(scaled3(1 / sqrt(square), w));
    const reals2 centre = lens_centre(camera, f->p);
    reals2 lo = {0, 0}, hi = {0, 0};
    real least = 1;
    for (int k = 0; k < BORDER; ++k) {
        const real c = widths * cos(TURN / BORDER * k), s = widths * sin(TURN / BORDER * k);
        const reals3 u = plus3(around.row2, combined3(c, around.row0, s, around.row1));
        const reals3 d = camera_rotate(camera, mat3_mul(&f->rotation, times3(f->scales, u)));
        const real length = sqrt(dot3(d, d));
        least = fmin(least, dot3(d, f->frame.row2) / length);
        const reals2 at = lens_centre(camera, d);
        real dx = at.x - centre.x;
        const real dy = at.y - centre.y;
#if LENS == EQUIRECTANGULAR
        const real turn = TURN * camera->fx;
        dx -= turn * rint(dx / turn);
#else
        if (d.z < (real)-0.85 * length) // close to the point that a fisheye spreads over a circle
            return whole_image(camera);
#endif
        lo.x = fmin(lo.x, dx);
        lo.y = fmin(lo.y, dy);
        hi.x = fmax(hi.x, dx);
        hi.y = fmax(hi.y, dy);
    }
    if (least < WIDE_COS)
        return whole_image(camera);
    const real grown = 1 + acos(least);
    real left = centre.x + grown * lo.x, right = centre.x + grown * hi.x;
    real top = centre.y + grown * lo.y, bottom = centre.y + grown * hi.y;
#if LENS == EQUIRECTANGULAR
    // A pole in or near the cone, or the seam behind the camera: all columns.
    const real half_turn = (real)0.5 * TURN * camera->fx;
    const reals3 y_axis = mat3_tmul(&f->rotation, camera_rotate_back(camera, vector3(0, 1, 0)));
    const reals3 pole = vector3(y_axis.x * inv.x, y_axis.y * inv.y, y_axis.z * inv.z);
    const real along = dot3(around.row2, pole), wide = (real)1.5 * grown * widths;
    const bool polar = dot3(pole, pole) - along * along <= wide * wide * along * along;
    if (polar && along > 0)
        bottom = camera->height + 1;
    if (polar && along < 0)
        top = -1;
    if (polar || left < camera->cx - half_turn || right > camera->cx + half_turn || right - left > half_turn) {
        left = -1;
        right = camera->width + 1;
    }
#endif
    const Outline outline = {{(real)0.5 * (left + right), (real)0.5 * (top + bottom)},
                             {(real)0.5 * (right - left), (real)0.5 * (bottom - top)},
                             {0, 0, 0}};
    return outline;
}

#endif

#endif
