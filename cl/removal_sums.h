// Sums of a splat over the tiles, for both variants of the stage removal.
//
// Mapping: one work-item per splat. Buffers as in removal_cpu.cl.
#ifndef CLSPLAT_REMOVAL_SUMS_H
#define CLSPLAT_REMOVAL_SUMS_H

// Number of reals of a record.
#define SUMS (6 + CHANNELS)

__kernel void removal_sum(const uint n, const __global uint *first_slots, const __global real *records,
                          __global real *sums) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    for (int k = 0; k < SUMS; ++k) {
        real total = 0;
        for (uint slot = first_slots[i]; slot < first_slots[i + 1]; ++slot)
            total += records[(size_t)SUMS * slot + k];
        sums[(size_t)SUMS * i + k] = total;
    }
}

#endif
