// composite_sum: the records of a splat, one per tile, added up in the order of their slots. Both variants
// end with it.
//
// Mapping: one work-item per splat, in depth order (bin.cl). Buffers as in composite_cpu.cl.
#ifndef CLSPLAT_COMPOSITE_SUM_H
#define CLSPLAT_COMPOSITE_SUM_H

__kernel void composite_sum(const uint n, const __global uint *order, const __global uint *first_slots,
                            const __global real *records, __global real *v_means2d, __global real *v_conics,
                            __global real *v_opacities, __global real *v_colors) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    real total[RECORD];
    for (int k = 0; k < RECORD; ++k)
        total[k] = 0;
    for (uint slot = first_slots[i]; slot < first_slots[i + 1]; ++slot) {
        for (int k = 0; k < RECORD; ++k)
            total[k] += records[(size_t)RECORD * slot + k];
    }
    const uint g = order[i];
    vstore2((real2)(total[0], total[1]), g, v_means2d);
    store3(v_conics, g, (real3)(total[2], total[3], total[4]));
    v_opacities[g] = total[5];
    for (int k = 0; k < CHANNELS; ++k)
        v_colors[CHANNELS * g + k] = total[6 + k];
}

#endif
