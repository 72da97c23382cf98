// Steps per splat of all variants of the stage composite, before and after the pixels.
//   composite_pack  packs the splats for compositing (composite.h)
//   composite_sum   adds up a splat's records, one per tile, in the order of their slots, and computes its gradients:
//     v_mean2d = -sum_pixels v_sigma (a dx + b dy, b dx + c dy),   v_conic = sum_pixels v_sigma (dx^2/2, dx dy, dy^2/2),
//     v_opacity = -sum_pixels v_sigma / opacity,                   v_colour = sum_pixels weight v_image
//
// Mapping: one work-item per splat. Buffers as in composite_cpu.cl.
#ifndef CLSPLAT_COMPOSITE_SPLATS_H
#define CLSPLAT_COMPOSITE_SPLATS_H

#if RAYS
// Of a row of rays: RAY_REALS in gaussian_rays.h.
#define ROW_REALS (RAYS == 2 ? 17 : 8)

// The outline as in ellipses_of (ellipse.h); r2 in the unit of 2 sigma.
static inline Outline outline_of(real2 centre, real2 extent, real3 conic, real level) {
    Outline e = {centre.x, centre.y, extent.y, 0, 0, 0, extent.x * extent.x};
    if (conic.x > 0) {
        e.inv_half_height = 1 / extent.y;
        e.at_right = -conic.y / conic.z * extent.x;
        e.slope = -conic.y / conic.x;
        e.half_sq = ((real)(2 / LOG2_E) * (level - (real)LOG2_ALPHA_MIN) + 2 * EXTENT_SLACK) / conic.x;
    }
    return e;
}
#endif

#if !RAYS
// u_x, u_y and v_y of a splat (composite.h). The determinant of a needle's conic is a small difference: it is computed
// without cancellation (Kahan; see Jeannerod et al. 2013, "Further analysis of Kahan's algorithm"), and not below what
// the rounding of the conic leaves uncertain.
static inline real3 factor_of(real3 conic) {
    const real half_log2_e = (real)(0.5 * LOG2_E), square = conic.y * conic.y;
    const real det = fma(conic.x, conic.z, -square) - fma(conic.y, conic.y, -square);
    const real u_x = sqrt(half_log2_e * conic.x), least = EPSILON * conic.z, rest = det / conic.x;
    return conic.x > 0 ? (real3)(u_x, half_log2_e * conic.y / u_x, sqrt(half_log2_e * GREATER(rest, least)))
                       : (real3)0;
}
#endif

__kernel void composite_pack(const uint n, const __global real *means2d, const __global real *conics,
                             const __global real *extents, const __global real *opacities, const __global real *colors
#if RAYS
                             ,
                             const __global real *rays
#endif
                             ,
                             __global Splat *splats) {
    const size_t i = get_global_id(0);
    if (i >= n || !(extents[2 * i] > 0))
        return;
    Splat s;
    s.level = logarithm(opacities[i]);
#if RAYS
    rays += (size_t)ROW_REALS * i;
    const real3 conic = (real3)(rays[2], rays[3], rays[4]);
    s.slope_x = rays[5];
    s.slope_y = rays[6];
    s.rest = (real)(2 / LOG2_E) * rays[7];
    s.outline = outline_of(load2(means2d, i), load2(extents, i), load3(conics, i), s.level);
#else
    const real3 conic = load3(conics, i);
    const real3 factor = factor_of(conic);
    s.u_x = factor.x;
    s.u_y = factor.y;
    s.v_y = factor.z;
    s.half_height = extents[2 * i + 1];
    s.at_right = -conic.y / conic.z * extents[2 * i];
#endif
#if RAYS == 2
    for (int k = 0; k < 3; ++k) {
        s.axis0[k] = rays[8 + k];
        s.axis1[k] = rays[11 + k];
        s.axis2[k] = rays[14 + k];
    }
#elif RAYS
    s.x = rays[0];
    s.y = rays[1];
#else
    s.x = means2d[2 * i];
    s.y = means2d[2 * i + 1];
#endif
#if RAYS
    s.a = (real)(-0.5 * LOG2_E) * conic.x;
    s.b = (real)-LOG2_E * conic.y;
    s.c = (real)(-0.5 * LOG2_E) * conic.z;
#endif
    for (int k = 0; k < CHANNELS; ++k)
        s.color[k] = colors[CHANNELS * i + k];
    splats[i] = s;
}

__kernel void composite_sum(const uint n, const __global uint *first_slots, const __global real *conics,
                            const __global real *opacities, const __global real *records, __global real *v_means2d,
                            __global real *v_conics,
#if RAYS
                            __global real *v_slopes,
#endif
                            __global real *v_opacities, __global real *v_colors) {
    const size_t g = get_global_id(0);
    if (g >= n)
        return;
    real total[RECORD];
    for (int k = 0; k < RECORD; ++k)
        total[k] = 0;
    const uint begin = first_slots[g], end = first_slots[g + 1];
    for (uint slot = begin; slot < end; ++slot) {
        for (int k = 0; k < RECORD; ++k)
            total[k] += records[(size_t)RECORD * slot + k];
    }
#if RAYS
    const __global real *row = conics + (size_t)ROW_REALS * g; // of rays
    const real3 conic = (real3)(row[2], row[3], row[4]);
    const real2 v_mean = -(real2)(conic.x * total[1] + conic.y * total[2] + row[5] * total[6],
                                  conic.y * total[1] + conic.z * total[2] + row[6] * total[6]);
    const real3 v_slope = (real3)(total[7], total[8], total[9]);
    const real3 v_conic = (real3)((real)0.5 * total[3], total[4], (real)0.5 * total[5]);
#else
    // dy = v/v_y and dx = u/u_x - turn v, and sigma = ln(2) (u^2 + v^2).
    const real3 factor = factor_of(load3(conics, g));
    const real inv_x = 1 / factor.x, inv_y = 1 / factor.z, turn = factor.y * inv_x * inv_y;
    const real2 v_mean =
        (real)(-2 / LOG2_E) * (real2)(factor.x * total[1], factor.y * total[1] + factor.z * total[2]);
    const real3 v_conic =
        (real3)((real)0.5 * (inv_x * inv_x * total[3] - 2 * inv_x * turn * total[4] + turn * turn * total[5]),
                inv_y * (inv_x * total[4] - turn * total[5]), (real)0.5 * inv_y * inv_y * total[5]);
#endif
    const real v_opacity = begin < end ? -total[0] / opacities[g] : 0;
    // Gradients that overflow are set to 0: they would stay in the statistics of densification.
    real any = v_mean.x + v_mean.y + v_conic.x + v_conic.y + v_conic.z + v_opacity;
#if RAYS
    any += v_slope.x + v_slope.y + v_slope.z;
#endif
    for (int k = 0; k < CHANNELS; ++k)
        any += total[MOMENTS + k];
    const bool finite = FINITE(any);
    store2(v_means2d, g, finite ? v_mean : (real2)0);
    store3(v_conics, g, finite ? v_conic : (real3)0);
#if RAYS
    store3(v_slopes, g, finite ? v_slope : (real3)0);
#endif
    v_opacities[g] = finite ? v_opacity : 0;
    for (int k = 0; k < CHANNELS; ++k)
        v_colors[CHANNELS * g + k] = finite ? total[MOMENTS + k] : 0;
}

#endif
