// Blocks of LANES pixels, and the splats that meet them, for kernels in which a work-item has a whole tile.
//
// A block is one vector, 4 pixels wide and LANES / 4 high. A splat visits only the blocks that its ellipse meets. They
// are found for a batch of splats before the first of them is composited, with splats as the lanes of vectors: for each
// row of blocks, the range of x that the ellipse spans (ellipse.h) yields the first and the last block, as bits.
//
// -DLANES=8|16   size of the device's vector registers: 16 floats if it has 512 bits, otherwise 8
#ifndef CLSPLAT_COMPOSITE_BLOCKS_H
#define CLSPLAT_COMPOSITE_BLOCKS_H

#if TILE != 8 && TILE != 16 && TILE != 32
#error "-DTILE must be 8, 16 or 32"
#endif
#if LANES != 8 && LANES != 16
#error "-DLANES must be 8 or 16, the pixels of a block"
#endif
#if TILE * TILE / LANES > 64
#error "-DTILE must be 8 or 16 with -DLANES=8: a set of blocks has 64 bits"
#endif
#define REALV   CONCATENATE(real, LANES)
#define MASKV   CONCATENATE(mask, LANES)
#define INTV    CONCATENATE(int, LANES)
#define TO_INTV CONCATENATE(TO_INT, LANES)
#ifdef USE_DOUBLE
#define MINUS_ABSOLUTE(x) LESSER(x, -(x))
#else
#define MINUS_ABSOLUTE(x) CONCATENATE(as_float, LANES)(CONCATENATE(as_uint, LANES)(x) | 0x80000000u)
#endif
#include "composite.h"
#include "power.h"

#define BLOCK_ROWS (LANES / 4)
#define COLUMNS    (TILE / 4)
#define ROWS       (TILE / BLOCK_ROWS)
#define BLOCKS     (ROWS * COLUMNS)

// Pixels of a block, in lanes: centres relative to its corner.
#if LANES == 16
#define PIXEL_X ((real16)(0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5))
#define PIXEL_Y ((real16)(0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5, 2.5, 2.5, 2.5, 2.5, 3.5, 3.5, 3.5, 3.5))
#else
#define PIXEL_X ((real8)(0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5))
#define PIXEL_Y ((real8)(0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5))
#endif

// Lane i of a vector in memory.
#define LANE(vector, i) (((const real *)&(vector))[i])

// A set of blocks: bit b is that of block b. In halves of 32 bits, a row of blocks lies within one.
typedef ulong Blocks;
#define HALVES ((BLOCKS + 31) / 32)

static inline real8 half_sums(REALV v) {
#if LANES == 16
    return v.lo + v.hi;
#else
    return v;
#endif
}

static inline real sum_lanes(REALV v) {
    const real8 a = half_sums(v);
    const real4 b = a.lo + a.hi;
    const real2 c = b.lo + b.hi;
    return c.x + c.y;
}

// The sums of a and b, in halves of four.
static inline real8 pair_sums(REALV a, REALV b) {
    const real8 x = half_sums(a), y = half_sums(b);
    return (real8)(x.lo, y.lo) + (real8)(x.hi, y.hi);
}

// Adds neighbours, and puts those of each half of y behind those of x.
static inline real8 neighbour_sums(real8 x, real8 y) {
    return (real8)(x.s02, y.s02, x.s46, y.s46) + (real8)(x.s13, y.s13, x.s57, y.s57);
}

// The sums over the lanes of eight vectors, by a tree that they share.
static inline real8 sum_lanes8(REALV v0, REALV v1, REALV v2, REALV v3, REALV v4, REALV v5, REALV v6, REALV v7) {
    const real8 v0415 = neighbour_sums(pair_sums(v0, v4), pair_sums(v1, v5));
    return neighbour_sums(v0415, neighbour_sums(pair_sums(v2, v6), pair_sums(v3, v7)));
}

// The bits that are set in any lane.
static inline uint bits_of_lanes(MASKV bits) {
#if LANES == 16
    const mask8 m8 = bits.lo | bits.hi;
    const mask4 m4 = m8.lo | m8.hi;
#else
    const mask4 m4 = bits.lo | bits.hi;
#endif
    return m4.x | m4.y | m4.z | m4.w;
}

static inline bool any_lane(MASKV mask) {
    return bits_of_lanes(mask) != 0;
}

// A tile: its first pixel, and the size of its part inside the image.
typedef struct {
    int x0, y0, columns, rows;
} Box;

static inline Box tile_box(uint tile, int width, int height) {
    const int tiles_x = (width + TILE - 1) / TILE;
    const int x0 = tile % tiles_x * TILE, y0 = tile / tiles_x * TILE;
    const Box box = {x0, y0, LESSER(TILE, width - x0), LESSER(TILE, height - y0)};
    return box;
}

// Whether a lane of block b lies inside the image; if the last one does, all do.
static inline bool lane_inside(const Box *box, uint b, int lane) {
    return 4 * (int)(b % COLUMNS) + lane % 4 < box->columns && BLOCK_ROWS * (int)(b / COLUMNS) + lane / 4 < box->rows;
}

// Index of its pixel.
static inline size_t lane_pixel(const Box *box, int width, uint b, int lane) {
    const int x = box->x0 + 4 * (int)(b % COLUMNS) + lane % 4;
    const int y = box->y0 + BLOCK_ROWS * (int)(b / COLUMNS) + lane / 4;
    return (size_t)y * width + x;
}

// Copies the `count` numbers of a pixel.
INLINED void load_lane(const __global real *pixel, int count, int lane, REALV *block) {
    _Pragma("unroll") for (int k = 0; k < count; ++k)((real *)&block[k])[lane] = pixel[k];
}

INLINED void store_lane(const REALV *block, int count, int lane, __global real *pixel) {
    _Pragma("unroll") for (int k = 0; k < count; ++k) pixel[k] = LANE(block[k], lane);
}

// Reads `count` numbers of each pixel of a block; those of pixels outside the image are 0.
INLINED void load_block(const __global real *values, int count, const Box *box, int width, uint b, REALV *block) {
    if (lane_inside(box, b, LANES - 1)) {
        _Pragma("unroll") for (int lane = 0; lane < LANES; ++lane)
            load_lane(values + count * lane_pixel(box, width, b, lane), count, lane, block);
        return;
    }
    for (int k = 0; k < count; ++k)
        block[k] = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        if (lane_inside(box, b, lane))
            load_lane(values + count * lane_pixel(box, width, b, lane), count, lane, block);
    }
}

INLINED void store_block(const REALV *block, int count, const Box *box, int width, uint b, __global real *values) {
    if (lane_inside(box, b, LANES - 1)) {
        _Pragma("unroll") for (int lane = 0; lane < LANES; ++lane)
            store_lane(block, count, lane, values + count * lane_pixel(box, width, b, lane));
        return;
    }
    for (int lane = 0; lane < LANES; ++lane) {
        if (lane_inside(box, b, lane))
            store_lane(block, count, lane, values + count * lane_pixel(box, width, b, lane));
    }
}

// Writes the image and its alpha in a block of composited pixels.
INLINED void store_pixels(REALV transmittance, const REALV *sums, const __global real *background, const Box *box,
                          int width, uint b, __global real *image, __global real *alpha_image) {
    const REALV left = ABSOLUTE(transmittance), alpha = 1 - left;
    REALV color[CHANNELS];
    _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) color[k] = sums[k] + left * background[k];
    store_block(color, CHANNELS, box, width, b, image);
    store_block(&alpha, 1, box, width, b, alpha_image);
}

// Reads the gradients of a block of the image into v_color. Returns S of each pixel before the first splat
// (composite_cpu.cl).
INLINED REALV load_v_pixels(const __global real *image, const __global real *alpha_image,
                            const __global real *v_image, const __global real *v_alpha_image, const Box *box,
                            int width, uint b, REALV *v_color) {
    REALV color[CHANNELS], alpha, v_alpha;
    load_block(image, CHANNELS, box, width, b, color);
    load_block(alpha_image, 1, box, width, b, &alpha);
    load_block(v_image, CHANNELS, box, width, b, v_color);
    load_block(v_alpha_image, 1, box, width, b, &v_alpha);
    REALV behind = (alpha - 1) * v_alpha;
    _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) behind += color[k] * v_color[k];
    return behind;
}

// Corners of the blocks relative to the tile's, px.
typedef struct {
    real x[BLOCKS], y[BLOCKS];
#if RAYS == 2
    REALV rays[BLOCKS][3]; // directions of the pixels' rays; 0 outside the image, where gradients are 0
#endif
} Grid;

static inline Grid pixel_grid(void) {
    Grid grid;
    for (int b = 0; b < BLOCKS; ++b) {
        grid.x[b] = 4 * (b % COLUMNS);
        grid.y[b] = BLOCK_ROWS * (b / COLUMNS);
    }
    return grid;
}

// Arguments of a kernel that reads the directions of the pixels' rays, and their loading.
#if RAYS == 2
#define DIRECTIONS , const __global real *directions
#define LOAD_DIRECTIONS(grid, box)                                                                                   \
    for (int b = 0; b < BLOCKS; ++b)                                                                                 \
        load_block(directions, 3, box, width, b, (grid).rays[b]);
#else
#define DIRECTIONS
#define LOAD_DIRECTIONS(grid, box)
#endif

// The blocks of a tile as seen from a splat: the pixels of the first one, and what the columns and rows of blocks add to
// it. So a block takes additions only.
typedef struct {
#if RAYS != 2
    Offset corner;
#endif
#if !RAYS
    real8 u_columns, u_rows, v_rows;
#endif
} Sight;

static inline Sight sight_from(const Splat *s, const Box *box) {
    Sight sight;
#if RAYS != 2
    sight.corner = offset_at(s, PIXEL_X + (box->x0 - s->x), PIXEL_Y + (box->y0 - s->y));
#endif
#if !RAYS
    const real8 numbers = (real8)(0, 1, 2, 3, 4, 5, 6, 7);
    sight.u_columns = s->u_x * (4 * numbers);
    sight.u_rows = s->u_y * (BLOCK_ROWS * numbers);
    sight.v_rows = s->v_y * (BLOCK_ROWS * numbers);
#endif
    return sight;
}

static inline Offset offset_in(const Grid *grid, uint b, const Splat *s, const Sight *sight) {
#if RAYS == 2
    const REALV x = grid->rays[b][0], y = grid->rays[b][1], z = grid->rays[b][2];
    const Offset o = {s->axis0[0] * x + s->axis0[1] * y + s->axis0[2] * z,
                      s->axis1[0] * x + s->axis1[1] * y + s->axis1[2] * z,
                      s->axis2[0] * x + s->axis2[1] * y + s->axis2[2] * z};
#elif RAYS
    const Offset o = {sight->corner.dx + grid->x[b], sight->corner.dy + grid->y[b], 1};
#else
    const uint column = b % COLUMNS, row = b / COLUMNS;
    const Offset o = {sight->corner.u + LANE(sight->u_columns, column) + LANE(sight->u_rows, row),
                      sight->corner.v + LANE(sight->v_rows, row)};
#endif
    return o;
}

#define SQRTV CONCATENATE(ROOT, LANES)
#if LANES == 16
DEFINE_POWER(16)
#define POWERV power16
#else
DEFINE_POWER(8)
#define POWERV power8
#endif

#include "composite_bands.h"

// Counting zeros in one instruction makes compositing a tenth faster. OpenCL C 1.2 has no function for it, and Oclgrind
// 21.10, which is based on Clang, cannot run the built-in (-DWITHOUT_CTZ).
static inline uint lowest_bit(ulong bits) {
#if defined(__clang__) && !defined(WITHOUT_CTZ)
    return __builtin_ctzl(bits);
#else
    return 63 - (uint)clz(bits & -bits);
#endif
}

// Removes the next block from a set that is not empty.
static inline uint take_block(Blocks *blocks) {
    const uint next = lowest_bit(*blocks);
    *blocks &= *blocks - 1;
    return next;
}

// The blocks with an unfinished pixel. The transmittances of neighbouring blocks are `stride` vectors apart.
static inline Blocks unfinished_blocks(const REALV *transmittance, uint stride) {
    Blocks blocks = 0;
    for (int h = 0; h < HALVES; ++h) {
        MASKV bits = 0; // of 32 blocks, for each lane
        _Pragma("unroll") for (int b = 0; b < LESSER(BLOCKS, 32); ++b) bits |=
            (transmittance[(32 * h + b) * stride] > 0) & ((MASKV)1 << b);
        blocks |= (Blocks)bits_of_lanes(bits) << 32 * h;
    }
    return blocks;
}

// Number of splats whose blocks are found before the first of them is composited. A processor cannot predict the end
// of the loop over blocks; if the bits are available early, it knows the end early. Finished blocks are searched
// between batches, which costs about as much as a few splats.
#define BATCH 64

// Splats, and the blocks of the tile that they meet.
typedef struct {
    Splat splats[BATCH];
    INTV halves[HALVES][BATCH / LANES];
} Batch;

static inline Blocks blocks_of(const Batch *batch, uint j) {
#if HALVES == 2
    return ((const uint *)batch->halves[0])[j] | (Blocks)((const uint *)batch->halves[1])[j] << 32;
#else
    return ((const uint *)batch->halves[0])[j];
#endif
}

// Outlines of a batch of splats (ellipse.h), with splats in lanes.
typedef struct {
    REALV x[BATCH / LANES], y[BATCH / LANES]; // centre, px
    REALV half_height[BATCH / LANES], at_right[BATCH / LANES];
#if RAYS
    REALV inv_half_height[BATCH / LANES], slope[BATCH / LANES], half_sq[BATCH / LANES];
#else
    REALV u_x[BATCH / LANES], u_y[BATCH / LANES], level[BATCH / LANES];
#endif
} Outlines;

static inline void set_outline(Outlines *outlines, uint j, const Splat *s) {
#if RAYS
    const Outline *e = &s->outline;
    ((real *)outlines->inv_half_height)[j] = e->inv_half_height;
    ((real *)outlines->slope)[j] = e->slope;
    ((real *)outlines->half_sq)[j] = e->half_sq;
#else
    const Splat *e = s;
    ((real *)outlines->u_x)[j] = s->u_x;
    ((real *)outlines->u_y)[j] = s->u_y;
    ((real *)outlines->level)[j] = s->level;
#endif
    ((real *)outlines->x)[j] = e->x;
    ((real *)outlines->y)[j] = e->y;
    ((real *)outlines->half_height)[j] = e->half_height;
    ((real *)outlines->at_right)[j] = e->at_right;
}

// Finds the blocks of the tile whose pixel centres the ellipses of LANES splats meet.
static inline void find_blocks(const Outlines *outlines, uint g, const Box *box, Batch *batch) {
    const REALV x = outlines->x[g] - (real)box->x0, y = outlines->y[g] - (real)box->y0;
#if RAYS
    const BandOutline outline = {x,
                                 y,
                                 outlines->half_height[g],
                                 outlines->inv_half_height[g],
                                 outlines->at_right[g],
                                 outlines->slope[g],
                                 outlines->half_sq[g]};
#else
    const BandOutline outline = band_outline(x, y, outlines->half_height[g], outlines->at_right[g], outlines->u_x[g],
                                             outlines->u_y[g], outlines->level[g]);
#endif
    INTV halves[HALVES];
    _Pragma("unroll") for (int h = 0; h < HALVES; ++h) halves[h] = 0;
    _Pragma("unroll") for (int r = 0; r < ROWS; ++r) {
        REALV begin, end;
        blocks_in_band(&outline, BLOCK_ROWS * r, BLOCK_ROWS * (r + 1) - 1, 4, COLUMNS, &begin, &end);
        const INTV bits = ((INTV)1 << TO_INTV(end)) - ((INTV)1 << TO_INTV(begin));
        halves[r * COLUMNS / 32] |= bits << (r * COLUMNS % 32);
    }
    _Pragma("unroll") for (int h = 0; h < HALVES; ++h) batch->halves[h][g] = halves[h];
}

// Prefetches the splat of entry i of a list that ends at `end`. Most splats span two cache lines. To be called between
// the splats of the batch before: of many requests at once, most would wait for others.
static inline void fetch_splat(const __global Splat *splats, const __global uint *gauss_ids, uint i, uint end) {
    if (i < end) {
        FETCH_TO_READ(&splats[gauss_ids[i]]);
        FETCH_TO_READ(&splats[gauss_ids[i]].color[CHANNELS - 1]);
    }
}

// Number of splats between the prefetch of a record and its writing.
#define AHEAD 8

// Prefetches the record, of `size` reals, that is written AHEAD splats after that of entry i.
static inline void fetch_record(__global real *records, int size, const __global uint *slots, uint i, uint end) {
    if (i + AHEAD < end) {
        __global real *record = records + (size_t)size * slots[i + AHEAD];
        FETCH_TO_WRITE(record);
        FETCH_TO_WRITE(record + size - 1);
    }
}

// Loads up to BATCH splats, beginning with the entry `first` of the list. Returns their number.
static inline uint load_batch(const __global Splat *splats, const __global uint *gauss_ids, uint first, uint end,
                              const Box *box, Batch *batch) {
    const uint count = LESSER((uint)BATCH, end - first);
    Outlines outlines;
    // All loads come first, so that cache misses overlap.
    for (uint j = 0; j < count; ++j) {
        batch->splats[j] = splats[gauss_ids[first + j]];
        set_outline(&outlines, j, &batch->splats[j]);
    }
    for (uint g = 0; g * LANES < count; ++g)
        find_blocks(&outlines, g, box, batch);
    return count;
}

// Transmittance 1 inside the image. Pixels outside count as finished.
static inline REALV transmittance_at_first(const Grid *grid, int b, const Box *box) {
    const MASKV inside = (PIXEL_X < (REALV)(box->columns - grid->x[b])) & (PIXEL_Y < (REALV)(box->rows - grid->y[b]));
    return inside ? (REALV)1 : (REALV)-1;
}

// The pixels of a block in the forward pass. What a visit of the block needs lies together, so that it takes one index.
typedef struct {
    REALV transmittance, color[CHANNELS];
} BlockPixels;

static inline BlockPixels pixels_at_first(const Grid *grid, int b, const Box *box) {
    BlockPixels pixels = {transmittance_at_first(grid, b, box), {0}};
    return pixels;
}

// A splat in a block of pixels.
typedef struct {
    uint block;
    Offset offset;
    Bend bend;
    REALV alpha;
} Visit;

// The visit of the next block of a set that is not empty.
static inline Visit next_visit(const Grid *grid, const Splat *s, const Sight *sight, Blocks *blocks) {
    Visit visit;
    visit.block = take_block(blocks);
    visit.offset = offset_in(grid, visit.block, s, sight);
    const REALV t = splat_exponent(s, &visit.offset, &visit.bend);
    visit.alpha = splat_alpha(splat_seen(s, t), POWERV(t));
    return visit;
}

// Composites the entries [begin, end) of a tile's list over its blocks. A pixel is finished where the transmittance
// would fall to `stop` or below.
static inline void composite_tile(const Grid *grid, const __global Splat *splats, const __global uint *gauss_ids,
                                  uint begin, uint end, const Box *box, real stop, BlockPixels *pixels) {
    Batch batch;
    for (uint first = begin; first < end; first += BATCH) {
        const Blocks unfinished = unfinished_blocks(&pixels->transmittance, sizeof(BlockPixels) / sizeof(REALV));
        if (!unfinished)
            break;
        const uint count = load_batch(splats, gauss_ids, first, end, box, &batch);
        for (uint j = 0; j < count; ++j) {
            fetch_splat(splats, gauss_ids, first + BATCH + j, end);
            const Splat *s = &batch.splats[j];
            const Sight sight = sight_from(s, box);
            for (Blocks blocks = unfinished & blocks_of(&batch, j); blocks;) {
                const Visit visit = next_visit(grid, s, &sight, &blocks);
                BlockPixels *here = &pixels[visit.block];
                MASKV live;
                const REALV weight = splat_over(visit.alpha, stop, &live, &here->transmittance);
                _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) here->color[k] += weight * s->color[k];
            }
        }
    }
}

#endif
