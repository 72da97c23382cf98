// Stage adam: one step of Adam (adam.h) on an array of parameters, in place.
//
// Mapping: one work-item per run of `width` values. Runs begin `stride` values apart, and values between two runs are
// not changed. The first `split` values of a run have a separate learning rate. A row of spherical harmonics is a
// run: it starts with degree 0 and ends with the trained bands. All other arrays are cut into runs of 16 values,
// that of the log_scales into runs of 15. Training uses the same update fused with the gradients, in project.cl.
//
// The penalties of the sums of all opacities and scales add o (1 - o) to the gradients of the logits, and the scale
// to the gradients of its logarithm. The third penalty depends on the effective ranks (adam.h). For it, runs of
// ln(scales) consist of whole rows. Each penalty is 0 for the other fields, and for Gaussians that are not shown:
// those with extents[N,2] of 0, unless extents is NULL.
//
// adam_array takes a step on an array of any parameters, in runs of `run` values. With `sparse`, parameters without a
// gradient stay as they are, and so do their moments (Müller et al. 2022, section 4).
//
// Buffers, `total` values each: in and out parameters; in gradients; in and out first (m), second (v).
#include "common.h"
#include "adam.h"

DEFINE_ADAM(16)

// The first `count` of 16 values, and 0 for the others, which are not read. Indices into vectors are constants: others
// would keep a vector out of the registers.
static inline real16 load_some(const __global real *values, int count) {
    if (count == 16)
        return load16(values);
    real16 result = 0;
#pragma unroll
    for (int i = 0; i < 16; ++i)
        if (i < count)
            ((real *)&result)[i] = values[i];
    return result;
}

static inline void store_some(__global real *values, int count, real16 v) {
    if (count == 16) {
        store16(values, v);
        return;
    }
#pragma unroll
    for (int i = 0; i < 16; ++i)
        if (i < count)
            values[i] = ((const real *)&v)[i];
}

// An update of `count` adjacent parameters, at most 16. Nothing beyond them is read or written.
static inline void adam_update_some(const Adam *adam, real16 rates, int count, real16 g, __global real *parameters,
                                    __global real *first, __global real *second) {
    real16 m = load_some(first, count), v = load_some(second, count);
    store_some(parameters, count, adam_update16(adam, rates, load_some(parameters, count), g, &m, &v));
    store_some(first, count, m);
    store_some(second, count, v);
}

__kernel void adam_step(const uint total, const uint stride, const uint width, const uint split,
                        const real split_rate, const real rate, const real opacity_penalty, const real scale_penalty,
                        const real erank_penalty, const Adam adam, const uint row, const __global real *extents,
                        __global real *parameters, const __global real *gradients, __global real *first,
                        __global real *second) {
    const size_t begin = get_global_id(0) * stride;
    if (begin >= total)
        return;
    const size_t end = LESSER(begin + width, (size_t)total);
    real16 rates = rate;
#pragma unroll
    for (uint i = 0; i < 16; ++i)
        if (i < split)
            ((real *)&rates)[i] = split_rate;
    for (size_t i = begin; i < end; i += 16, rates = rate) {
        const int count = LESSER((size_t)16, end - i);
        real16 g = load_some(gradients + i, count);
        real16 shown = 1;
        if (extents && (opacity_penalty != 0 || scale_penalty != 0 || erank_penalty != 0))
#pragma unroll
            for (int k = 0; k < 16; ++k)
                if (k < count)
                    ((real *)&shown)[k] = extents[2 * ((i + k) / row)] > 0;
        if (opacity_penalty != 0 || scale_penalty != 0) {
            const real16 p = load_some(parameters + i, count);
            // o (1 - o) for the logit p of o, even in p
            const real16 below = -ABSOLUTE(p), e = OF16(exp, below);
            const real16 of_scales = scale_penalty != 0 ? scale_penalty * OF16(exp, p) : 0;
            g += shown > 0 ? opacity_penalty * e / ((1 + e) * (1 + e)) + of_scales : 0; // not infinity times 0
        }
        // In this case, runs consist of whole rows.
#pragma unroll
        for (int k = 0; k < 15; k += 3) {
            if (erank_penalty == 0 || k + 3 > count)
                continue;
            const real weight = erank_penalty * ((const real *)&shown)[k];
            const real3 v = weight * erank_vjp(load3(parameters + i, k / 3), adam.erank_slack);
            ((real *)&g)[k] += v.x;
            ((real *)&g)[k + 1] += v.y;
            ((real *)&g)[k + 2] += v.z;
        }
        adam_update_some(&adam, rates, count, g, parameters + i, first + i, second + i);
    }
}

__kernel void adam_array(const uint total, const uint run, const int sparse, const real rate, const Adam adam,
                         __global real *parameters, const __global real *gradients, __global real *first,
                         __global real *second) {
    const size_t begin = get_global_id(0) * run, end = LESSER(begin + run, (size_t)total);
    for (size_t i = begin; i < end; i += 16) {
        if (end - i < 16) {
            for (size_t k = i; k < end; ++k) {
                const real16 g = gradients[k];
                if (!sparse || g.s0 != 0)
                    adam_update_some(&adam, rate, 1, g, parameters + k, first + k, second + k);
            }
            continue;
        }
        const real16 g = load16(gradients + i);
        const mask16 moved = g != 0, kept = moved || (mask16)(!sparse);
        if (sparse && !(any(moved.lo.lo) || any(moved.lo.hi) || any(moved.hi.lo) || any(moved.hi.hi)))
            continue;
        real16 m = load16(first + i), v = load16(second + i);
        const real16 p = load16(parameters + i), old_m = m, old_v = v;
        const real16 next = adam_update16(&adam, rate, p, g, &m, &v);
        store16(parameters + i, kept ? next : p);
        store16(first + i, kept ? m : old_m);
        store16(second + i, kept ? v : old_v);
    }
}
