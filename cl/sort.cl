// Stage sort: stable argsort of unsigned integer keys.
//
//   order is the permutation that sorts keys; equal keys keep their order.
//
// Two algorithms with the same result:
//
// Radix sort, least significant digit first. The n keys are cut into `groups` blocks of contiguous keys, one per
// work-group. A pass over one digit of DIGIT_BITS bits:
//   sort_count    counts the digits of each block
//   sort_scatter  turns the counts into positions, and writes keys and values in order
// Blocks are in the order of groups, and a block keeps the order of its keys, so that the sort is stable.
// With GROUP = 1, which is fastest on a CPU core, a block is a sequential counting sort. The counts are
// histogram[digit][g], and the stage scan turns them into positions in between.
// With larger groups, for GPUs, the counts are histogram[g][digit], and each group adds up those of the groups before
// it: no launch in between. It takes its block in chunks of GROUP * RUN keys, which it sorts by the digit in local
// memory, so that neighbouring work-items write to neighbouring addresses. The counters of a chunk's sort are per
// digit of 4 bits and work-item, so that it is stable; it takes DIGIT_BITS / 4 passes.
//
// Bitonic sort of up to BITONIC keys by one work-group in local memory (Batcher 1968), for short lists. It compares
// pairs (key, position), which makes it stable.
//
// Segments of an array are sorted by one work-group each: short ones by the bitonic sort (sort_short_segments), longer
// ones by passes as above within the work-group (sort_long_segments). Each kernel ignores the segments of the other.
//
// Buffers: keys_in[n], values_in[n] (not read where use_positions is 1: the positions 0 to n - 1 instead),
//          keys_out[n], values_out[n], histogram[2^DIGIT_BITS * groups], offsets[2^DIGIT_BITS * groups + 1] its
//          exclusive scan with GROUP = 1, otherwise the histogram; ranges[segments,2], begin and end of each.
// -DKEY_BITS=32|64   width of a key
// -DDIGIT_BITS       bits per pass, 1 to 16; with a larger GROUP than 1, a multiple of 4 up to 8
// -DGROUP            work-group size of the radix sort, at least 1
// -DSEGMENT_BITS     bits per pass in a segment, 1 to 11
// -DSEGMENT_GROUP    work-group size of the radix sort of segments, at least 1
// -DBITONIC          capacity of the bitonic sort, a power of two, at least 2
// -DBITONIC_GROUP    its work-group size, 1 to BITONIC / 2
#include "common.h"

#if KEY_BITS == 32
typedef uint sort_key;
#define KEY_MAX UINT_MAX
#elif KEY_BITS == 64
typedef ulong sort_key;
#define KEY_MAX ULONG_MAX
#else
#error "-DKEY_BITS must be 32 or 64"
#endif
#if !defined(DIGIT_BITS) || DIGIT_BITS < 1 || DIGIT_BITS > 16
#error "-DDIGIT_BITS must be 1 to 16"
#endif
#if !defined(GROUP) || GROUP < 1
#error "-DGROUP must give the work-group size of the radix sort, at least 1"
#endif
#if GROUP > 1 && (DIGIT_BITS % 4 || DIGIT_BITS > 8)
#error "-DDIGIT_BITS must be 4 or 8 where -DGROUP is larger than 1"
#endif
#if !defined(SEGMENT_BITS) || SEGMENT_BITS < 1 || SEGMENT_BITS > 11
#error "-DSEGMENT_BITS must be 1 to 11"
#endif
#if !defined(SEGMENT_GROUP) || SEGMENT_GROUP < 1
#error "-DSEGMENT_GROUP must give the work-group size of the radix sort of segments, at least 1"
#endif
#if !defined(BITONIC) || BITONIC < 2 || BITONIC & (BITONIC - 1)
#error "-DBITONIC must be a power of two, at least 2"
#endif
#if !defined(BITONIC_GROUP) || BITONIC_GROUP < 1 || BITONIC_GROUP > BITONIC / 2
#error "-DBITONIC_GROUP must be 1 to BITONIC / 2"
#endif

#define DIGITS (1u << DIGIT_BITS)

static inline uint digit_of(sort_key key, uint shift, uint digits) {
    return (uint)(key >> shift) & (digits - 1);
}

#if GROUP == 1

// First key of block g.
static inline uint block_begin(uint n, uint groups, uint g) {
    return min(n, g * ((n + groups - 1) / groups));
}

__kernel void sort_count(const uint n, const uint groups, const uint shift, const __global sort_key *keys,
                         __global uint *histogram) {
    uint counts[DIGITS];
    const uint g = get_group_id(0), end = block_begin(n, groups, g + 1);
    for (uint d = 0; d < DIGITS; ++d)
        counts[d] = 0;
    for (uint i = block_begin(n, groups, g); i < end; ++i)
        ++counts[digit_of(keys[i], shift, DIGITS)];
    for (uint d = 0; d < DIGITS; ++d)
        histogram[d * groups + g] = counts[d];
}

__kernel void sort_scatter(const uint n, const uint groups, const uint shift, const uint use_positions,
                           const __global sort_key *keys_in, const __global uint *values_in,
                           const __global uint *offsets, __global sort_key *keys_out, __global uint *values_out) {
    uint positions[DIGITS];
    const uint g = get_group_id(0), end = block_begin(n, groups, g + 1);
    for (uint d = 0; d < DIGITS; ++d)
        positions[d] = offsets[d * groups + g];
    for (uint i = block_begin(n, groups, g); i < end; ++i) {
        const sort_key key = keys_in[i];
        const uint position = positions[digit_of(key, shift, DIGITS)]++;
        keys_out[position] = key;
        values_out[position] = use_positions ? i : values_in[i];
    }
}

#else

// Number of keys of a work-item in a chunk. Loops over them are unrolled, so that the keys stay in registers.
#define RUN   8
#define CHUNK (GROUP * RUN)

// First key of block g. Blocks are whole chunks.
static inline uint block_begin(uint n, uint groups, uint g) {
    const uint chunks = (n + CHUNK - 1) / CHUNK, per_block = (chunks + groups - 1) / groups;
    return min(n, g * per_block * CHUNK);
}

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void sort_count(const uint n, const uint groups,
                                                                            const uint shift,
                                                                            const __global sort_key *keys,
                                                                            __global uint *histogram) {
    __local uint counts[DIGITS];
    const uint g = get_group_id(0), end = block_begin(n, groups, g + 1);
    for (uint d = get_local_id(0); d < DIGITS; d += GROUP)
        counts[d] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint i = block_begin(n, groups, g) + get_local_id(0); i < end; i += GROUP)
        atomic_inc(&counts[digit_of(keys[i], shift, DIGITS)]);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint d = get_local_id(0); d < DIGITS; d += GROUP)
        histogram[g * DIGITS + d] = counts[d];
}

// Local memory of the sort of a chunk. `totals` holds one number per work-item, and `begins` one per digit.
typedef struct {
    sort_key keys[CHUNK];
    uint values[CHUNK];
    ushort counters[16 * GROUP];
    uint totals[GROUP];
    uint begins[DIGITS], positions[DIGITS];
} Chunk;

// The sum of totals[0 .. lane - 1], where totals[lane] = own; ends with a barrier.
static inline uint sum_before(__local uint *totals, uint own) {
    const uint lane = get_local_id(0);
    totals[lane] = own;
    barrier(CLK_LOCAL_MEM_FENCE);
    // Hillis and Steele 1986: after the step of width w, totals[lane] sums the last 2 w lanes.
    for (uint width = 1; width < GROUP; width *= 2) {
        const uint left = lane >= width ? totals[lane - width] : 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        totals[lane] += left;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    const uint result = totals[lane] - own;
    barrier(CLK_LOCAL_MEM_FENCE);
    return result;
}

// Sorts the chunk by 4 bits of the digit; begins and ends with a barrier.
static inline void sort_nibble(__local Chunk *chunk, uint shift, uint digits) {
    const uint lane = get_local_id(0);
    sort_key keys[RUN];
    uint values[RUN], places[RUN];
    for (uint d = 0; d < 16; ++d)
        chunk->counters[d * GROUP + lane] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    _Pragma("unroll") for (uint j = 0; j < RUN; ++j) {
        keys[j] = chunk->keys[lane * RUN + j];
        values[j] = chunk->values[lane * RUN + j];
        places[j] = chunk->counters[digit_of(keys[j], shift, digits) * GROUP + lane]++;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    uint total = 0;
    for (uint k = lane * 16; k < lane * 16 + 16; ++k)
        total += chunk->counters[k];
    uint running = sum_before(chunk->totals, total);
    for (uint k = lane * 16; k < lane * 16 + 16; ++k) {
        const uint count = chunk->counters[k];
        chunk->counters[k] = (ushort)running;
        running += count;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    _Pragma("unroll") for (uint j = 0; j < RUN; ++j) {
        const uint to = places[j] + chunk->counters[digit_of(keys[j], shift, digits) * GROUP + lane];
        chunk->keys[to] = keys[j];
        chunk->values[to] = values[j];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// positions[digit] of the block's first key of each digit; ends with a barrier.
static inline void first_positions(uint groups, const __global uint *histogram, __local Chunk *chunk) {
    const uint lane = get_local_id(0), g = get_group_id(0);
    // Contiguous digits per work-item, so that their totals are summed up in order.
    const uint per_item = (DIGITS + GROUP - 1) / GROUP;
    uint own = 0;
    for (uint d = lane * per_item; d < min(DIGITS, (lane + 1) * per_item); ++d) {
        uint before = 0, total = 0;
        for (uint other = 0; other < groups; ++other) {
            const uint count = histogram[other * DIGITS + d];
            before += other < g ? count : 0;
            total += count;
        }
        chunk->positions[d] = before;
        chunk->begins[d] = total;
        own += total;
    }
    uint running = sum_before(chunk->totals, own);
    for (uint d = lane * per_item; d < min(DIGITS, (lane + 1) * per_item); ++d) {
        chunk->positions[d] += running;
        running += chunk->begins[d];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void
sort_scatter(const uint n, const uint groups, const uint shift, const uint use_positions,
             const __global sort_key *keys_in, const __global uint *values_in, const __global uint *histogram,
             __global sort_key *keys_out, __global uint *values_out) {
    __local Chunk chunk;
    const uint lane = get_local_id(0), g = get_group_id(0), end = block_begin(n, groups, g + 1);
    first_positions(groups, histogram, &chunk);
    for (uint first = block_begin(n, groups, g); first < end; first += CHUNK) {
        const uint count = min((uint)CHUNK, end - first);
        for (uint i = lane; i < CHUNK; i += GROUP) {
            // Padding stays last: its digit is the largest, and it comes after all keys.
            chunk.keys[i] = i < count ? keys_in[first + i] : KEY_MAX;
            chunk.values[i] = i < count ? (use_positions ? first + i : values_in[first + i]) : 0;
        }
        for (uint bit = 0; bit < DIGIT_BITS; bit += 4)
            sort_nibble(&chunk, shift + bit, 16);
        for (uint i = lane; i < count; i += GROUP) {
            const uint d = digit_of(chunk.keys[i], shift, DIGITS);
            if (i == 0 || digit_of(chunk.keys[i - 1], shift, DIGITS) != d)
                chunk.begins[d] = i;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint i = lane; i < count; i += GROUP) {
            const sort_key key = chunk.keys[i];
            const uint d = digit_of(key, shift, DIGITS), to = chunk.positions[d] + i - chunk.begins[d];
            keys_out[to] = key;
            values_out[to] = chunk.values[i];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint i = lane; i < count; i += GROUP) {
            const uint d = digit_of(chunk.keys[i], shift, DIGITS);
            if (i == count - 1 || digit_of(chunk.keys[i + 1], shift, DIGITS) != d)
                chunk.positions[d] += i + 1 - chunk.begins[d];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
}

#endif

// Sorts `size` pairs of local memory by (key, value), size a power of two; ends with a barrier.
static inline void bitonic(uint size, __local sort_key *keys, __local uint *values) {
    for (uint block = 2; block <= size; block *= 2) {
        for (uint stride = block / 2; stride > 0; stride /= 2) {
            for (uint pair = get_local_id(0); pair < size / 2; pair += BITONIC_GROUP) {
                const uint low = 2 * stride * (pair / stride) + pair % stride, high = low + stride;
                const bool ascending = (low & block) == 0;
                const sort_key a = keys[low], b = keys[high];
                const uint u = values[low], v = values[high];
                const bool in_order = a < b || (a == b && u < v);
                if (in_order != ascending) {
                    keys[low] = b;
                    keys[high] = a;
                    values[low] = v;
                    values[high] = u;
                }
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
    }
}

// Loads n <= size keys and their positions; ends with a barrier.
static inline void bitonic_load(uint n, uint size, const __global sort_key *keys_in, __local sort_key *keys,
                                __local uint *values) {
    for (uint i = get_local_id(0); i < size; i += BITONIC_GROUP) {
        // Padding is last: no key is larger, and its position decides the tie with a key of the same value.
        keys[i] = i < n ? keys_in[i] : KEY_MAX;
        values[i] = i;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

__kernel void sort_bitonic(const uint n, const uint use_positions, const __global sort_key *keys_in,
                           const __global uint *values_in, __global sort_key *keys_out, __global uint *values_out) {
    __local sort_key keys[BITONIC];
    __local uint values[BITONIC];
    bitonic_load(n, BITONIC, keys_in, keys, values);
    bitonic(BITONIC, keys, values);
    for (uint i = get_local_id(0); i < n; i += BITONIC_GROUP) {
        keys_out[i] = keys[i];
        values_out[i] = use_positions ? values[i] : values_in[values[i]];
    }
}

__kernel void sort_short_segments(const uint use_positions, const __global uint *ranges,
                                  const __global sort_key *keys_in, const __global uint *values_in,
                                  __global uint *values_out) {
    __local sort_key keys[BITONIC];
    __local uint values[BITONIC];
    const uint begin = ranges[2 * get_group_id(0)], length = ranges[2 * get_group_id(0) + 1] - begin;
    const uint n = length <= BITONIC ? length : 0; // the other kernel sorts longer segments
    uint size = 1;
    while (size < n)
        size *= 2;
    bitonic_load(n, size, keys_in + begin, keys, values);
    bitonic(size, keys, values);
    for (uint i = get_local_id(0); i < n; i += BITONIC_GROUP) {
        const uint from = begin + values[i];
        values_out[begin + i] = use_positions ? from : values_in[from];
    }
}

#define SEGMENT_DIGITS (1u << SEGMENT_BITS)

// Passes over one segment, which alternate between the outputs and the spare arrays, so that the last one writes the
// outputs.
__kernel void sort_long_segments(const uint use_positions, const uint bits, const __global uint *ranges,
                                 const __global sort_key *keys_in, const __global uint *values_in,
                                 __global sort_key *keys_out, __global uint *values_out,
                                 __global sort_key *spare_keys, __global uint *spare_values) {
    __local uint counts[SEGMENT_DIGITS * SEGMENT_GROUP];
    __local uint totals[SEGMENT_GROUP];
    const uint lane = get_local_id(0);
    const uint begin = ranges[2 * get_group_id(0)], length = ranges[2 * get_group_id(0) + 1] - begin;
    const uint passes = length > BITONIC ? (bits + SEGMENT_BITS - 1) / SEGMENT_BITS : 0;
    const uint run = (length + SEGMENT_GROUP - 1) / SEGMENT_GROUP;
    const uint from = begin + min(length, lane * run), to = begin + min(length, lane * run + run);
    for (uint pass = 0; pass < passes; ++pass) {
        const bool last = (passes - pass) % 2;
        const __global sort_key *keys = pass == 0 ? keys_in : last ? spare_keys : keys_out;
        const __global uint *values = pass == 0 ? values_in : last ? spare_values : values_out;
        __global sort_key *new_keys = last ? keys_out : spare_keys;
        __global uint *new_values = last ? values_out : spare_values;
        const uint shift = pass * SEGMENT_BITS;
        for (uint d = 0; d < SEGMENT_DIGITS; ++d)
            counts[d * SEGMENT_GROUP + lane] = 0;
        for (uint i = from; i < to; ++i)
            ++counts[digit_of(keys[i], shift, SEGMENT_DIGITS) * SEGMENT_GROUP + lane];
        barrier(CLK_LOCAL_MEM_FENCE);
        // Turns counts, ordered by digit and then by lane, into positions. Each lane takes SEGMENT_DIGITS of them.
        uint total = 0;
        for (uint k = lane * SEGMENT_DIGITS; k < (lane + 1) * SEGMENT_DIGITS; ++k)
            total += counts[k];
        totals[lane] = total;
        barrier(CLK_LOCAL_MEM_FENCE);
        uint position = begin;
        for (uint left = 0; left < lane; ++left)
            position += totals[left];
        for (uint k = lane * SEGMENT_DIGITS; k < (lane + 1) * SEGMENT_DIGITS; ++k) {
            const uint count = counts[k];
            counts[k] = position;
            position += count;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint i = from; i < to; ++i) {
            const sort_key key = keys[i];
            const uint at = counts[digit_of(key, shift, SEGMENT_DIGITS) * SEGMENT_GROUP + lane]++;
            new_keys[at] = key;
            new_values[at] = pass == 0 && use_positions ? i : values[i];
        }
        barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    }
}
