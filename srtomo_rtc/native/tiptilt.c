/* Tip-tilt's loop of its own: stars' frames put together, and its integrator. Described in srtomo_rtc/loop.py. */
#include "frame.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "kernel.h"

bool srt_tip_tilt_new(srt_loop *loop, uint32_t sensors)
{
    srt_stars *stars = &loop->stars;
    loop->tip_tilt.sensors = sensors;
    bool complete = (stars->given_slopes = srt_floats(loop->n_slopes)) &&
                    (stars->coming_slopes = srt_floats(loop->n_slopes));
    float **vectors[] = {&loop->tip_tilt.command, &stars->base, &stars->trial, &stars->product};
    for (size_t i = 0; i < sizeof vectors / sizeof *vectors; i++)
        complete = (*vectors[i] = srt_floats(loop->n_rows)) && complete;
    return complete;
}

void srt_tip_tilt_free(srt_loop *loop)
{
    srt_stars *stars = &loop->stars;
    float *owned[] = {loop->tip_tilt.command, stars->base,         stars->trial,
                      stars->product,         stars->given_slopes, stars->coming_slopes};
    for (size_t i = 0; i < sizeof owned / sizeof *owned; i++)
        free(owned[i]);
}

void srt_tip_tilt_start(srt_loop *loop)
{
    srt_tip_tilt *own = &loop->tip_tilt;
    srt_stars *stars = &loop->stars;
    own->frame = stars->given = stars->coming = stars->jumped_to = -1;
    own->used = stars->arrived = 0;
    stars->expected = own->sensors;
    memset(own->command, 0, loop->n_rows * sizeof(float));
}

/* -- frames of the stars' own count -------------------------------------------------------------------------------- */

/* Leave what has come of the coming frame for the next answer. */
static void give(srt_loop *loop)
{
    srt_tip_tilt *own = &loop->tip_tilt;
    srt_stars *stars = &loop->stars;
    stars->over = true;
    if (stars->given >= 0)
        own->skipped++;
    stars->given = stars->coming;
    stars->given_sensors = stars->arrived & stars->finite;
    memcpy(stars->given_slopes, stars->coming_slopes, loop->n_slopes * sizeof(float));
}

static enum srt_put begin(srt_loop *loop, int64_t frame)
{
    srt_stars *stars = &loop->stars;
    if (stars->coming >= 0 && frame > stars->coming + SRT_AHEAD) {
        bool agreed = 0 < frame - stars->jumped_to && frame - stars->jumped_to <= SRT_AHEAD && stars->jumped_to >= 0;
        stars->jumped_to = agreed ? -1 : frame;
        if (!agreed)
            return SRT_STRAY;
    }
    if (stars->arrived) {
        if (!stars->over)
            give(loop);
        stars->expected = stars->arrived; /* a star that did not come is waited for no longer */
    }
    stars->coming = frame;
    stars->arrived = stars->finite = 0;
    stars->over = false;
    return SRT_PUT;
}

enum srt_put srt_tip_tilt_put(srt_loop *loop, int64_t frame, uint32_t first, uint32_t n, const void *slopes)
{
    srt_stars *stars = &loop->stars;
    uint32_t sensors = (uint32_t)(((1ull << n) - 1) << first);
    const char *place = slopes;
    if (frame < stars->coming)
        return SRT_LATE;
    if (frame > stars->coming && begin(loop, frame) == SRT_STRAY)
        return SRT_STRAY;
    if (stars->arrived & sensors)
        return SRT_DUPLICATE;
    stars->arrived |= sensors;
    for (uint32_t w = first; w < first + n; w++) {
        size_t count = 2 * (size_t)loop->n_subapertures[w];
        float *mine = stars->coming_slopes + loop->first_slope[w];
        srt_interleave(place, loop->n_subapertures[w], mine);
        place += count * sizeof(float);
        if (srt_all_finite(mine, count))
            stars->finite |= 1u << w;
    }
    if (!stars->over && (stars->arrived & stars->expected) == stars->expected)
        give(loop);
    return SRT_PUT;
}

void srt_tip_tilt_give(srt_loop *loop, int64_t frame, uint32_t sensors, const float *slopes)
{
    srt_stars *stars = &loop->stars;
    for (uint32_t w = 0; w < loop->n_sensors; w++)
        if (sensors >> w & 1)
            srt_interleave(slopes + loop->first_slope[w], loop->n_subapertures[w],
                           stars->given_slopes + loop->first_slope[w]);
    stars->given = frame;
    stars->given_sensors = sensors;
}

/* -- the integrator ------------------------------------------------------------------------------------------------ */

/* trial = keep t + gain R_t (y - y_ref) of the stars that came, the mean over them. False: t has to stay as it is, since
 * it would leave the range of an actuator, or of all; back towards the middle it may always go. */
static bool step(srt_loop *loop)
{
    srt_tip_tilt *own = &loop->tip_tilt;
    srt_stars *stars = &loop->stars;
    const srt_program *program = loop->program;
    const srt_tip_tilt_law *law = &program->tip_tilt;
    float share = 0.0f, *restrict trial = stars->trial;
    const float *t = own->command, *limit = program->limit;
    memset(trial, 0, loop->n_rows * sizeof(float));
    for (uint32_t w = 0; w < loop->n_sensors; w++) {
        if (!(stars->given_sensors >> w & 1))
            continue;
        share += law->weight[w];
        float *slopes = stars->given_slopes + loop->first_slope[w];
        const float *reference = law->reference + loop->first_slope[w];
        for (size_t i = 0; i < 2 * (size_t)loop->n_subapertures[w]; i++)
            slopes[i] -= reference[i];
        srt_loop_add_product(loop, program->alone, w, slopes, stars->product, trial);
    }
    float gain = stars->given_sensors == own->sensors ? law->gain : law->gain / share;
    bool within = true;
    for (size_t i = 0; i < loop->n_rows; i++) {
        trial[i] = law->keep * t[i] + gain * trial[i];
        within = within && (fabsf(trial[i]) <= limit[i] || fabsf(trial[i]) <= fabsf(t[i]));
    }
    if (program->rms != INFINITY && within) {
        double rms = srt_loop_rms(loop, trial);
        within = rms <= program->rms || rms <= srt_loop_rms(loop, t);
    }
    return within && srt_all_finite(trial, loop->n_rows);
}

const float *srt_tip_tilt_answer(srt_loop *loop)
{
    srt_tip_tilt *own = &loop->tip_tilt;
    srt_stars *stars = &loop->stars;
    const float *offset = loop->program->offset;
    if (!own->sensors)
        return offset;
    int64_t frame = stars->given;
    stars->given = -1;
    own->used = 0;
    if (loop->closed && frame >= 0) {
        if (stars->given_sensors && step(loop)) {
            memcpy(own->command, stars->trial, loop->n_rows * sizeof(float));
            own->frame = frame;
            own->used = stars->given_sensors;
            own->frames++;
            own->partial += own->used != own->sensors;
        } else {
            own->held++;
        }
    }
    for (size_t i = 0; i < loop->n_rows; i++)
        stars->base[i] = offset[i] + own->command[i];
    return stars->base;
}
