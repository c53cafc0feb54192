/* Products of a matrix whose blocks, zones of commands by zones of sub-apertures, are held as low-rank factors U V of
 * 16-bit integers: first the rows of V, then those of U. What the factors are, srtomo_rtc/lowrank.py says. */
#ifndef SRTOMO_LOWRANK_H
#define SRTOMO_LOWRANK_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "crew.h"

/* One block of a zone's: U is SRT_TILE_INT16 rows by these rows of V; or the block's own rows stand in V, and U is 1. */
typedef struct {
    const int16_t *U;    /* (last - first, SRT_TILE_INT16) */
    uint32_t first, last; /* rows of V */
    uint32_t whole;
} srt_block;

/* The columns of one zone of sub-apertures. */
typedef struct {
    const uint32_t *columns; /* (n_columns) where its slopes stand among the sensor's */
    uint32_t n_columns;
    uint32_t needs;          /* the first so many sub-apertures of the sensor have to be there */
    uint32_t n_inner;        /* rows of V, a multiple of SRT_TILE_INT16 */
    uint32_t scratch;        /* where its n_columns + n_inner floats begin */
    const int16_t *V;        /* in tiles */
    const float *V_scales;   /* (n_inner) */
    const srt_block *blocks; /* (row tiles), one each */
    size_t U_bytes;
} srt_zone;

/* R of one sensor. */
typedef struct {
    const srt_zone *zones; /* (n_zones) ascending in what they need */
    uint32_t n_zones, n_tiles;
    float *scratch;
} srt_low_rank;

/* sums += the products of the zones that need more than the first `before` sub-apertures and no more than the first
 * `now`, in the zones' order; the caller applies the rows' scales, and their places. */
void srt_low_rank_multiply(srt_crew *crew, const srt_low_rank *matrix, uint32_t before, uint32_t now,
                           const float *slopes, float *sums);

#endif
