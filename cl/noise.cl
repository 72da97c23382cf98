// Stage noise: a random walk of the means, shaped by the covariance of each Gaussian.
//
//   mean += size gate(opacity) Sigma eta,  Sigma = R S S^T R^T,  eta ~ N(0, I)          (Kheradmand et al. 2024,
//   gate(o) = 1 / (1 + exp(GATE_SLOPE (o - GATE_OPACITY)))                               equation 8 and section 3.2)
// eta comes from Philox4x32-10 (Salmon et al. 2011, section 3.3). Its counter is the Gaussian's index and the
// iteration, so that the integers are the same on every device, without a state. See docs/stages/noise.md;
// clsplat/reference/noise.py is the twin.
//
// Mapping: one work-item per Gaussian.
//
// Buffers, N Gaussians: in log_scales[N,3] ln(world), quats[N,4], logit_opacities[N]; in and out means[N,3] world
//
// -DGATE_SLOPE    slope of the gate by the opacity
// -DGATE_OPACITY  opacity at which the gate is one half
#include "common.h"
#include "linalg.h"
#include "philox.h"

#if !defined(GATE_SLOPE) || !defined(GATE_OPACITY)
#error "-DGATE_SLOPE and -DGATE_OPACITY, slope and middle of the gate, must be given"
#endif

DEFINE_POWER(4)

// Three independent standard normal numbers (Box and Muller 1958).
static inline real3 normals(uint4 bits) {
    const real4 u = ((real4)((real)bits.x, (real)bits.y, (real)bits.z, (real)bits.w) + (real)0.5) *
                    (real)2.3283064365386963e-10; // 2^-32: u is above 0 and at most 1
    const real2 radii = sqrt((real)(-2 / LOG2_E) * (real2)(logarithm(u.x), logarithm(u.z)));
    return radii.xxy * cospi((real)2 * (real4)(u.y, u.y - (real)0.25, u.w, 0)).xyz;
}

__kernel void add_noise(const uint n, const uint2 key, const uint iteration, const real size,
                        const __global real *log_scales, const __global real *quats,
                        const __global real *logit_opacities, __global real *means) {
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    const real4 q = load4(quats, i);
    const reals4 quat = {q.x, q.y, q.z, q.w};
    const real norm2 = dot4(quat, quat);
    if (!(norm2 >= QUAT_NORM2_MIN))
        return;
    // Squares of the scales, and exp(-logit).
    const real4 t = (real)LOG2_E * (real4)(2 * load3(log_scales, i), -logit_opacities[i]);
    const real4 e = power4(CLAMP(t, (real4)POWER_MIN, (real4)POWER_MAX));
    const real slope = (real)(GATE_SLOPE * LOG2_E) * (1 / (1 + e.w) - (real)GATE_OPACITY);
    const real gate = 1 / (1 + power4((real4)LESSER(slope, (real)POWER_MAX)).x);
    const mat3 rotation = rotation_from_quat(normalized4(quat));
    const real3 eta = normals(philox((uint4)((uint)i, iteration, 0, 0), key));
    const reals3 along = mat3_tmul(&rotation, vector3(eta.x, eta.y, eta.z));
    const reals3 step = mat3_mul(&rotation, times3(vector3(e.x, e.y, e.z), along));
    store3(means, i, load3(means, i) + size * gate * (real3)(step.x, step.y, step.z));
}
