// Stage composite, variant that sorts the splats of each pixel (--sort pixel), with its gradients.
//
// The equations are those of composite_cpu.cl. There, all pixels take the splats in the order of the depths of their
// centres. When two splats swap, all pixels that show both of them change at once: the image pops when the camera
// turns. Here, each pixel takes the splats in the order in which its ray meets them (project_disparities in
// project.cl). This order differs between pixels, and changes gradually with the camera (Radl et al. 2024,
// "StopThePop").
//
// A pixel is sorted exactly and in fixed memory, in rounds over the tile's list. In each round, a window collects the
// WINDOW nearest splats that the pixel shows and has not composited yet. They are composited, and the next round
// continues behind the last of them. Ties are decided by the list, that is by the depth of the centres and by index.
// Most pixels are finished after a few rounds. The list is almost in order, so a window fills early. A splat behind
// all windows of a block only costs the test for it.
//
// Mapping: one work-item per tile, with its pixels in blocks (composite_blocks.h). This variant is for all devices.
// At one position of a block's windows there are up to LANES different splats: their colours are gathered lane by
// lane, and their sums in the backward pass are scattered lane by lane. Only one work-item writes the records of a
// tile, in a fixed order: no atomics, and the same bits in each run.
//
// Buffers: as in composite_cpu.cl, and
//   in   disparities[N,3], as in project.cl
// -DTILE=8|16|32   edge of a tile, px
// -DCHANNELS    number of colour channels, 1 or more
// -DLANES=8|16  number of pixels of a block
// -DWINDOW      number of entries of a pixel's window, 1 or more
#define RAYS 0 // the disparities are those of the affine projection
#include "common.h"
#include "composite_blocks.h"

#if !defined(WINDOW) || WINDOW < 1
#error "-DWINDOW must give the number of entries of a pixel's window, 1 or more"
#endif

#ifdef USE_DOUBLE
#define ENTRY_LANE(vector, i) (((const long *)&(vector))[i])
#else
#define ENTRY_LANE(vector, i) (((const int *)&(vector))[i])
#endif

// One splat in each pixel of a block.
typedef struct {
    REALV disparity;
    REALV alpha; // not clamped; 0: none
    MASKV entry; // in the list of intersections
} Entry;

#define NOWHERE ((REALV)-INFINITY) // a disparity behind all others

// Inserts an entry into a window with at most `count` entries per pixel, nearest first. The farthest entry leaves a
// full window. Late entries belong far behind, so the search begins at the end, and stops when no pixel needs to
// continue.
static inline void window_insert(Entry *window, int count, Entry e) {
    int j = LESSER(count, WINDOW - 1);
    const MASKV kept = window[j].disparity >= e.disparity; // only if the window is full
    e.disparity = kept ? window[j].disparity : e.disparity;
    e.alpha = kept ? window[j].alpha : e.alpha;
    e.entry = kept ? window[j].entry : e.entry;
    for (; j > 0; --j) {
        const Entry here = window[j - 1];
        const MASKV nearer = e.disparity > here.disparity;
        if (!any_lane(nearer))
            break;
        window[j].disparity = nearer ? here.disparity : e.disparity;
        window[j].alpha = nearer ? here.alpha : e.alpha;
        window[j].entry = nearer ? here.entry : e.entry;
        e.disparity = nearer ? e.disparity : here.disparity;
        e.alpha = nearer ? e.alpha : here.alpha;
        e.entry = nearer ? e.entry : here.entry;
    }
    window[j] = e;
}

// Data of a tile for both passes.
typedef struct {
    const __global Splat *splats;
    const __global real *disparities;
    const __global uint *gauss_ids, *slots;
    __global real *records; // 0: forward
    const Box *box;
    const Grid *grid;
} Tile;

// The pixels of a tile. `sums` is the colour in the forward pass and v_image in the backward pass.
typedef struct {
    REALV transmittance[BLOCKS], behind[BLOCKS], sums[BLOCKS][CHANNELS];
    REALV last_disparity[BLOCKS]; // of the last composited splat; NOWHERE: none is left
    MASKV last_entry[BLOCKS];
    int counts[BLOCKS];
    Entry windows[BLOCKS][WINDOW];
} Pixels;

static inline void composite_forward(const Tile *tile, Pixels *pixels, int b, const Entry *e, REALV weight) {
    for (int lane = 0; lane < LANES; ++lane) {
        const real w = LANE(weight, lane);
        if (!(w > 0))
            continue;
        const __global Splat *s = &tile->splats[tile->gauss_ids[ENTRY_LANE(e->entry, lane)]];
        for (int k = 0; k < CHANNELS; ++k)
            ((real *)&pixels->sums[b][k])[lane] += w * s->color[k];
    }
}

static inline void composite_backward(const Tile *tile, Pixels *pixels, int b, const Entry *e, MASKV live,
                                      REALV weight) {
    REALV u = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        if (!(LANE(weight, lane) > 0))
            continue;
        const __global Splat *s = &tile->splats[tile->gauss_ids[ENTRY_LANE(e->entry, lane)]];
        real sum = 0;
        for (int k = 0; k < CHANNELS; ++k)
            sum += s->color[k] * LANE(pixels->sums[b][k], lane);
        ((real *)&u)[lane] = sum;
    }
    const REALV v_sigma = splat_over_vjp(e->alpha, live, weight, u, &pixels->behind[b]);
    const REALV x = PIXEL_X + (tile->box->x0 + tile->grid->x[b]), y = PIXEL_Y + (tile->box->y0 + tile->grid->y[b]);
    for (int lane = 0; lane < LANES; ++lane) {
        const real w = LANE(weight, lane), v = LANE(v_sigma, lane);
        if (!(w > 0))
            continue;
        const uint i = ENTRY_LANE(e->entry, lane);
        const __global Splat *s = &tile->splats[tile->gauss_ids[i]];
        const real dx = LANE(x, lane) - s->x, dy = LANE(y, lane) - s->y;
        const real along = s->u_x * dx + s->u_y * dy, across = s->v_y * dy;
        __global real *record = tile->records + (size_t)RECORD * tile->slots[i];
        record[0] += v;
        record[1] += v * along;
        record[2] += v * across;
        record[3] += v * along * along;
        record[4] += v * along * across;
        record[5] += v * across * across;
        for (int k = 0; k < CHANNELS; ++k)
            record[6 + k] += w * LANE(pixels->sums[b][k], lane);
    }
}

// Inserts a splat into the window of block b, for pixels that have not composited it yet and for which it is near
// enough.
static inline void gather_splat(const Tile *tile, const Splat *s, real3 disparity, uint entry, Pixels *pixels,
                                int b) {
    const REALV dx = PIXEL_X + (tile->grid->x[b] + (tile->box->x0 - s->x));
    const REALV dy = PIXEL_Y + (tile->grid->y[b] + (tile->box->y0 - s->y));
    const Offset o = offset_at(s, dx, dy);
    Bend bend;
    const REALV t = splat_exponent(s, &o, &bend);
    const REALV here = disparity.x + (dx * disparity.y + dy * disparity.z), last = pixels->last_disparity[b];
    const MASKV beyond = (here < last) | ((here == last) & ((MASKV)entry > pixels->last_entry[b]));
    const MASKV wanted = splat_seen(s, t) & beyond;
    Entry e;
    e.disparity = wanted ? here : NOWHERE;
    if (!any_lane(e.disparity > pixels->windows[b][WINDOW - 1].disparity))
        return;
    e.alpha = POWERV(t);
    e.entry = (MASKV)entry;
    window_insert(pixels->windows[b], pixels->counts[b], e);
    pixels->counts[b] += pixels->counts[b] < WINDOW;
}

// Composites the window of block b and empties it.
static inline void composite_window(const Tile *tile, Pixels *pixels, int b) {
    Entry *window = pixels->windows[b];
    pixels->counts[b] = 0;
    pixels->last_disparity[b] = window[WINDOW - 1].disparity;
    pixels->last_entry[b] = window[WINDOW - 1].entry;
    for (int j = 0; j < WINDOW; ++j) {
        Entry e = window[j];
        const MASKV seen = e.disparity > NOWHERE;
        if (!any_lane(seen))
            break;
        window[j].disparity = NOWHERE;
        e.alpha = splat_alpha(seen, e.alpha);
        MASKV live;
        const REALV weight = splat_over(e.alpha, TRANSMITTANCE_MIN, &live, &pixels->transmittance[b]);
        if (tile->records)
            composite_backward(tile, pixels, b, &e, live, weight);
        else
            composite_forward(tile, pixels, b, &e, weight);
    }
    pixels->last_disparity[b] = pixels->transmittance[b] > 0 ? pixels->last_disparity[b] : NOWHERE;
}

// Composites all splats of a tile, in rounds.
static inline void composite_list(const Tile *tile, uint begin, uint end, Pixels *pixels) {
    Blocks open = begin < end ? unfinished_blocks(pixels->transmittance, 1) : 0;
    for (int b = 0; b < BLOCKS; ++b) {
        pixels->last_disparity[b] = pixels->transmittance[b] > 0 ? (REALV)INFINITY : NOWHERE;
        pixels->counts[b] = 0;
        for (int j = 0; j < WINDOW; ++j)
            pixels->windows[b][j].disparity = NOWHERE;
    }
    Batch batch;
    while (open) {
        for (uint first = begin; first < end; first += BATCH) {
            const uint count = load_batch(tile->splats, tile->gauss_ids, first, end, tile->box, &batch);
            // One block after the other, so that its window stays in the nearest cache.
            for (Blocks blocks = open; blocks;) {
                const int b = take_block(&blocks);
                for (uint j = 0; j < count; ++j) {
                    if (blocks_of(&batch, j) >> b & 1)
                        gather_splat(tile, &batch.splats[j], load3(tile->disparities, tile->gauss_ids[first + j]),
                                     first + j, pixels, b);
                }
            }
        }
        for (Blocks blocks = open; blocks;) {
            const int b = take_block(&blocks);
            composite_window(tile, pixels, b);
            open ^= any_lane(pixels->last_disparity[b] > NOWHERE) ? 0 : (Blocks)1 << b;
        }
    }
}

__kernel void composite_fwd(const int width, const int height, const __global Splat *splats,
                            const __global uint *gauss_ids, const __global uint *tile_ranges,
                            const __global real *background, __global real *image, __global real *alpha_image,
                            const __global real *disparities) {
    const uint t = get_global_id(0);
    const Box box = tile_box(t, width, height);
    const Grid grid = pixel_grid();
    const Tile tile = {splats, disparities, gauss_ids, 0, 0, &box, &grid};

    Pixels pixels;
    for (int b = 0; b < BLOCKS; ++b) {
        pixels.transmittance[b] = transmittance_at_first(&grid, b, &box);
        for (int k = 0; k < CHANNELS; ++k)
            pixels.sums[b][k] = 0;
    }
    composite_list(&tile, tile_ranges[2 * t], tile_ranges[2 * t + 1], &pixels);

    for (int b = 0; b < BLOCKS; ++b)
        store_pixels(pixels.transmittance[b], pixels.sums[b], background, &box, width, b, image, alpha_image);
}

__kernel void composite_bwd(const int width, const int height, const __global Splat *splats,
                            const __global uint *gauss_ids, const __global uint *tile_ranges,
                            const __global uint *slots, const __global real *image, const __global real *alpha_image,
                            const __global real *v_image, const __global real *v_alpha_image, __global real *records,
                            const __global real *disparities) {
    const uint t = get_global_id(0);
    const Box box = tile_box(t, width, height);
    const Grid grid = pixel_grid();
    const Tile tile = {splats, disparities, gauss_ids, slots, records, &box, &grid};

    Pixels pixels;
    for (int b = 0; b < BLOCKS; ++b) {
        pixels.transmittance[b] = transmittance_at_first(&grid, b, &box);
        pixels.behind[b] = load_v_pixels(image, alpha_image, v_image, v_alpha_image, &box, width, b, pixels.sums[b]);
    }

    const uint begin = tile_ranges[2 * t], end = tile_ranges[2 * t + 1];
    for (uint i = begin; i < end; ++i) {
        for (int k = 0; k < RECORD; ++k)
            records[(size_t)RECORD * slots[i] + k] = 0;
    }
    composite_list(&tile, begin, end, &pixels);
}

#include "composite_splats.h"
