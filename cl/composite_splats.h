// Steps per splat of all variants of the stage composite, before and after the pixels.
//   composite_pack  packs the splats for compositing (composite.h)
//   composite_sum   adds up a splat's records, one per tile, in the order of their slots, and computes its gradients:
//     v_mean2d = -sum_pixels v_sigma (a dx + b dy, b dx + c dy),   v_conic = sum_pixels v_sigma (dx^2/2, dx dy, dy^2/2),
//     v_opacity = -sum_pixels v_sigma / opacity,                   v_colour = sum_pixels weight v_image
//
// Mapping: one work-item per splat, by index (composite_pack) or in depth order (composite_sum, see bin.cl). Buffers
// as in composite_cpu.cl.
#ifndef CLSPLAT_COMPOSITE_SPLATS_H
#define CLSPLAT_COMPOSITE_SPLATS_H

__kernel void composite_pack(const uint n, const __global real *means2d, const __global real *conics,
                             const __global real *extents, const __global real *opacities,
                             const __global real *colors, __global Splat *splats) {
    const size_t i = get_global_id(0);
    if (i >= n || !(extents[2 * i] > 0))
        return;
    const real3 conic = load3(conics, i);
    Splat s;
    s.x = means2d[2 * i];
    s.y = means2d[2 * i + 1];
    s.a = (real)(-0.5 * LOG2_E) * conic.x;
    s.b = (real)-LOG2_E * conic.y;
    s.c = (real)(-0.5 * LOG2_E) * conic.z;
    s.level = logarithm(opacities[i]);
    s.half_height = extents[2 * i + 1];
    s.at_right = -conic.y / conic.z * extents[2 * i];
    for (int k = 0; k < CHANNELS; ++k)
        s.color[k] = colors[CHANNELS * i + k];
    splats[i] = s;
}

__kernel void composite_sum(const uint n, const __global uint *order, const __global uint *first_slots,
                            const __global real *conics, const __global real *opacities, const __global real *records,
                            __global real *v_means2d, __global real *v_conics, __global real *v_opacities,
                            __global real *v_colors) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    real total[RECORD];
    for (int k = 0; k < RECORD; ++k)
        total[k] = 0;
    const uint begin = first_slots[i], end = first_slots[i + 1];
    for (uint slot = begin; slot < end; ++slot) {
        for (int k = 0; k < RECORD; ++k)
            total[k] += records[(size_t)RECORD * slot + k];
    }
    const uint g = order[i];
    const real3 conic = load3(conics, g);
    const real2 v_mean = -(real2)(conic.x * total[1] + conic.y * total[2], conic.y * total[1] + conic.z * total[2]);
    const real3 v_conic = (real3)((real)0.5 * total[3], total[4], (real)0.5 * total[5]);
    const real v_opacity = begin < end ? -total[0] / opacities[g] : 0;
    // Gradients that overflow are set to 0: they would stay in the statistics of densification.
    real any = v_mean.x + v_mean.y + v_conic.x + v_conic.y + v_conic.z + v_opacity;
    for (int k = 0; k < CHANNELS; ++k)
        any += total[6 + k];
    const bool finite = 0 * any == 0;
    store2(v_means2d, g, finite ? v_mean : (real2)0);
    store3(v_conics, g, finite ? v_conic : (real3)0);
    v_opacities[g] = finite ? v_opacity : 0;
    for (int k = 0; k < CHANNELS; ++k)
        v_colors[CHANNELS * g + k] = finite ? total[6 + k] : 0;
}

#endif
