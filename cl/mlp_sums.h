// Last step of the gradient of the weights, for both variants of the stage mlp: adds up its parts in their order.
//
// Mapping: one work-item per weight. Buffers: in parts[count, weight_count]; out v_weights[weight_count], or with
// `add` in and out.
#ifndef CLSPLAT_MLP_SUMS_H
#define CLSPLAT_MLP_SUMS_H

__kernel void mlp_sum(const uint weight_count, const uint count, const uint add, const __global real *parts,
                      __global real *v_weights) {
    const size_t i = get_global_id(0);
    if (i >= weight_count)
        return;
    real sum = add ? v_weights[i] : 0;
    for (size_t part = 0; part < count; ++part)
        sum += parts[part * weight_count + i];
    v_weights[i] = sum;
}

#endif
