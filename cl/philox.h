// Philox4x32-10 (Salmon et al. 2011, section 3.3): four random integers from a counter, without a state. Stages that
// draw for the same Gaussian in the same iteration use different third words of the counter.
#ifndef CLSPLAT_PHILOX_H
#define CLSPLAT_PHILOX_H

static inline uint4 philox(uint4 counter, uint2 key) {
    for (int round = 0; round < 10; ++round) {
        const ulong first = (ulong)0xD2511F53u * counter.x, second = (ulong)0xCD9E8D57u * counter.z;
        counter = (uint4)((uint)(second >> 32) ^ counter.y ^ key.x, (uint)second,
                          (uint)(first >> 32) ^ counter.w ^ key.y, (uint)first);
        key += (uint2)(0x9E3779B9u, 0xBB67AE85u);
    }
    return counter;
}

#endif
