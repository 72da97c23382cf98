// Stage finite: the number of values of an array that are infinite or not a number.
//
//   count += 1 for each i with values[i] not finite
// See docs/stages/finite.md; clsplat/reference/finite.py is the twin.
//
// Mapping: one work-item per value. Integers are added atomically, so the sum does not depend on the order. In a healthy
// training nothing is added: the kernel reads each value once.
//
// Buffers: in values[n]; in and out count[1] uint
#include "common.h"

__kernel void count_not_finite(const uint n, const __global real *values, __global uint *count) {
    const size_t i = get_global_id(0);
    if (i < n && !isfinite(values[i]))
        atomic_inc(count);
}
