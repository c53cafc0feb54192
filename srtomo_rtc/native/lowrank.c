#include "lowrank.h"

#include <string.h>

#include "kernel.h"

typedef struct {
    const srt_low_rank *matrix;
    const srt_zone *zones; /* the first of those that can be formed now */
    size_t n_zones;
    const float *slopes;
    float *sums;
} task;

/* V's part, zone by zone. */
static void go_in(const void *work, size_t from, size_t to)
{
    const task *t = work;
    for (const srt_zone *zone = t->zones + from; zone < t->zones + to; zone++) {
        float *restrict own = t->matrix->scratch + zone->scratch, *restrict inner = own + zone->n_columns;
        for (uint32_t i = 0; i < zone->n_columns; i++)
            own[i] = t->slopes[zone->columns[i]];
        memset(inner, 0, zone->n_inner * sizeof *inner);
        srt_accumulate_int16(zone->V, zone->n_inner / SRT_TILE_INT16, zone->n_columns, 0, zone->n_columns, own, inner);
        for (uint32_t i = 0; i < zone->n_inner; i++)
            inner[i] *= zone->V_scales[i];
    }
}

/* U's part, row tile by row tile: of each the zones in order. */
static void go_out(const void *work, size_t from, size_t to)
{
    const task *t = work;
    for (size_t tile = from; tile < to; tile++) {
        float *restrict sums = t->sums + tile * SRT_TILE_INT16;
        for (size_t z = 0; z < t->n_zones; z++) {
            const srt_zone *zone = t->zones + z;
            const srt_block *block = zone->blocks + tile;
            const float *inner = t->matrix->scratch + zone->scratch + zone->n_columns + block->first;
            size_t n = block->last - block->first;
            if (block->whole)
                for (size_t i = 0; i < n; i++)
                    sums[i] += inner[i];
            else
                srt_accumulate_int16(block->U, 1, n, 0, n, inner, sums);
        }
    }
}

void srt_low_rank_multiply(srt_crew *crew, const srt_low_rank *matrix, uint32_t before, uint32_t now,
                           const float *slopes, float *sums)
{
    const srt_zone *zone = matrix->zones, *end = zone + matrix->n_zones;
    while (zone < end && zone->needs <= before)
        zone++;
    task t = {.matrix = matrix, .zones = zone, .slopes = slopes, .sums = sums};
    size_t in = 0, out = 0;
    for (; zone < end && zone->needs <= now; zone++) {
        in += (size_t)zone->n_columns * zone->n_inner * sizeof(int16_t);
        out += zone->U_bytes;
    }
    t.n_zones = (size_t)(zone - t.zones);
    if (!t.n_zones)
        return;
    srt_crew_share(crew, go_in, &t, t.n_zones, in);
    srt_crew_share(crew, go_out, &t, matrix->n_tiles, out);
}
