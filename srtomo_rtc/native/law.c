#include "frame.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "crew.h"
#include "kernel.h"

float *srt_floats(size_t n)
{
    size_t bytes = (n * sizeof(float) + 63) / 64 * 64;
    float *made = aligned_alloc(64, bytes ? bytes : 64);
    if (made)
        memset(made, 0, bytes);
    return made;
}

static void zero(float *values, size_t n)
{
    memset(values, 0, n * sizeof *values);
}

static void copy(float *to, const float *from, size_t n)
{
    memcpy(to, from, n * sizeof *to);
}

static void expect_in_time(srt_loop *loop);

srt_loop *srt_loop_new(const uint32_t *n_subapertures, uint32_t n_sensors, uint32_t n_commands, float delay,
                       uint32_t max_epochs, uint32_t tip_tilt_sensors)
{
    if (n_sensors > SRT_MAX_SENSORS || max_epochs < 1 || max_epochs > SRT_MAX_EPOCHS)
        return NULL;
    srt_loop *loop = calloc(1, sizeof *loop);
    if (!loop)
        return NULL;
    loop->n_sensors = n_sensors;
    loop->all_sensors = loop->wanted = (uint32_t)((1ull << n_sensors) - 1) & ~tip_tilt_sensors;
    loop->n_commands = n_commands;
    loop->n_rows = (n_commands + SRT_TILE_INT16 - 1) / SRT_TILE_INT16 * SRT_TILE_INT16;
    loop->max_epochs = max_epochs;
    for (uint32_t w = 0; w < n_sensors; w++) {
        loop->n_subapertures[w] = n_subapertures[w];
        loop->first_slope[w] = loop->n_slopes;
        loop->n_slopes += 2 * n_subapertures[w];
    }
    loop->whole = (int64_t)floorf(delay);
    loop->fraction = (float)(1.0 - ((double)delay - (double)loop->whole));
    size_t m = loop->n_rows;
    float **vectors[] = {&loop->command, &loop->state, &loop->flat, &loop->on_mirror, &loop->q,
                         &loop->product, &loop->older, &loop->prepared, &loop->trial};
    bool complete = (loop->history = srt_floats(SRT_HISTORY * m)) && (loop->sums = srt_floats(n_sensors * m)) &&
                    (loop->slopes = srt_floats((size_t)SRT_ROWS * loop->n_slopes));
    for (size_t i = 0; i < sizeof vectors / sizeof *vectors; i++)
        complete = (*vectors[i] = srt_floats(m)) && complete;
    complete = srt_tip_tilt_new(loop, tip_tilt_sensors) && complete;
    if (!complete) {
        srt_loop_free(loop);
        return NULL;
    }
    srt_loop_start(loop, 0, 0);
    return loop;
}

void srt_loop_free(srt_loop *loop)
{
    if (!loop)
        return;
    float *owned[] = {loop->command, loop->state,   loop->flat,    loop->on_mirror, loop->q,    loop->product,
                      loop->older,   loop->prepared, loop->trial, loop->history,   loop->sums, loop->slopes};
    for (size_t i = 0; i < sizeof owned / sizeof *owned; i++)
        free(owned[i]);
    srt_tip_tilt_free(loop);
    free(loop);
}

void srt_interleave(const void *xy, size_t n, float *out)
{
    const char *x = xy, *y = x + n * sizeof(float);
    for (size_t i = 0; i < n; i++) {
        memcpy(out + 2 * i, x + i * sizeof(float), sizeof(float));
        memcpy(out + 2 * i + 1, y + i * sizeof(float), sizeof(float));
    }
}

void srt_loop_use(srt_loop *loop, srt_crew *crew)
{
    loop->crew = crew;
}

/* -- from any thread ---------------------------------------------------------------------------------------------- */

uint64_t srt_loop_post(srt_loop *loop, const srt_program *program)
{
    const srt_program *before = atomic_exchange(&loop->posted, program);
    return before ? before->token : 0;
}

void srt_loop_request(srt_loop *loop, int state)
{
    atomic_store(&loop->requested, state);
}

int srt_loop_pending(srt_loop *loop)
{
    int requested = atomic_load(&loop->requested);
    if (requested == SRT_CLOSED && !loop->token)
        requested = SRT_RELAXES;
    return atomic_load(&loop->posted) != NULL || requested != srt_loop_state_of(loop);
}

/* -- from the loop's thread --------------------------------------------------------------------------------------- */

void srt_loop_forget(srt_loop *loop)
{
    for (int row = 0; row < SRT_ROWS; row++)
        loop->kept[row] = -1;
}

static void no_sensor_came(srt_loop *loop)
{
    loop->sensors = 0;
    loop->finite = true;
    memset(loop->multiplied, 0, sizeof loop->multiplied);
    zero(loop->sums, (size_t)loop->n_sensors * loop->n_rows);
}

void srt_loop_start(srt_loop *loop, int64_t frame, int state)
{
    loop->frame = loop->first_frame = frame;
    loop->closed = state == SRT_CLOSED;
    loop->held_flat = state == SRT_FLAT;
    atomic_store(&loop->requested, state);
    loop->consecutive_holds = 0;
    loop->frames_closed = 0;
    loop->used = 0;
    loop->answered = -1;
    loop->verdict = SRT_OPEN;
    loop->n_clipped = loop->n_slewed = 0;
    loop->scaled = 0;
    zero(loop->state, loop->n_rows);
    zero(loop->history, (size_t)SRT_HISTORY * loop->n_rows);
    srt_loop_forget(loop);
    srt_tip_tilt_start(loop);
    loop->several = false;
    no_sensor_came(loop);
    expect_in_time(loop);
}

static void keep(srt_loop *loop, int64_t frame, bool kept, srt_mirror mirror)
{
    loop->kept[frame % SRT_ROWS] = kept ? frame : -1;
    loop->mirror[frame % SRT_ROWS] = mirror;
}

void srt_loop_remember(srt_loop *loop, int64_t frame, const float *slopes, int64_t newest, int64_t before,
                       float fraction)
{
    for (uint32_t w = 0; w < loop->n_sensors; w++)
        srt_interleave(slopes + loop->first_slope[w], loop->n_subapertures[w], srt_loop_slopes(loop, frame, w));
    keep(loop, frame, true, (srt_mirror){newest, before, fraction});
}

static const float *shown(const srt_loop *loop, int64_t frame)
{
    return frame >= loop->first_frame ? loop->history + (size_t)(frame % SRT_HISTORY) * loop->n_rows : loop->flat;
}

/* Of float32. */
static size_t n_tiles(const srt_loop *loop)
{
    return (loop->n_commands + SRT_TILE - 1) / SRT_TILE;
}

/* R_w y for columns first .. last - 1 of one sensor, onto sums; 16-bit integers are not scaled yet. */
static void accumulate(const srt_loop *loop, const srt_matrices *matrices, uint32_t sensor, size_t first, size_t last,
                       const float *slopes, float *sums)
{
    if (matrices->low_rank) {
        srt_low_rank_multiply(loop->crew, matrices->low_rank + sensor, (uint32_t)first / 2, (uint32_t)last / 2, slopes,
                              sums);
        return;
    }
    bool int16 = matrices->R_scales[sensor] != NULL;
    srt_product product = {.tiles = matrices->R[sensor], .n_tiles = int16 ? loop->n_rows / SRT_TILE_INT16 : n_tiles(loop),
                           .n_columns = 2 * (size_t)loop->n_subapertures[sensor], .first = first, .last = last,
                           .vector = slopes, .sums = sums, .int16 = int16};
    srt_crew_multiply(loop->crew, &product);
}

/* total += sums of one sensor, scaled if they are of integers. */
static void add_scaled(const srt_loop *loop, const srt_matrices *matrices, uint32_t sensor, const float *sums,
                       float *restrict total)
{
    const float *scales = matrices->R_scales[sensor];
    const uint32_t *rows = matrices->rows;
    if (rows)
        for (size_t i = 0; i < loop->n_rows; i++)
            total[rows[i]] += scales[i] * sums[i];
    else if (scales)
        for (size_t i = 0; i < loop->n_rows; i++)
            total[i] += scales[i] * sums[i];
    else
        for (size_t i = 0; i < loop->n_rows; i++)
            total[i] += sums[i];
}

void srt_loop_add_product(const srt_loop *loop, const srt_matrices *matrices, uint32_t sensor, const float *slopes,
                          float *product, float *total)
{
    zero(product, loop->n_rows);
    accumulate(loop, matrices, sensor, 0, 2 * (size_t)loop->n_subapertures[sensor], slopes, product);
    add_scaled(loop, matrices, sensor, product, total);
}

/* out = Q u~ with the state that was on the mirror, and with what tip-tilt's own loop had put there. */
static void multiply_mirror(srt_loop *loop, const float *Q, srt_mirror mirror, float *out)
{
    size_t m = loop->n_rows;
    const float *newest = shown(loop, mirror.newest), *before = shown(loop, mirror.before);
    const float *offset = loop->program->offset;
    float share = mirror.fraction, rest = 1.0f - share, *restrict u = loop->on_mirror;
    for (size_t i = 0; i < m; i++)
        u[i] = (share * newest[i] + rest * before[i]) - offset[i];
    zero(out, m);
    srt_product product = {.tiles = Q, .n_tiles = n_tiles(loop), .n_columns = loop->n_commands,
                           .last = loop->n_commands, .vector = u, .sums = out};
    srt_crew_multiply(loop->crew, &product);
}

static bool kept_back(const srt_loop *loop, int64_t n)
{
    for (int64_t frame = loop->frame - n; frame < loop->frame; frame++)
        if (frame < 0 || loop->kept[frame % SRT_ROWS] != frame)
            return false;
    return true;
}

/* The part of c that earlier exposures make, if the program uses them and all are here. */
static void form_older(srt_loop *loop)
{
    const srt_program *program = loop->program;
    loop->several = program && program->n_epochs > 1 && kept_back(loop, program->n_epochs - 1);
    loop->matrices = !program ? NULL : loop->several ? program->epochs : program->alone;
    if (!loop->several)
        return;
    zero(loop->older, loop->n_rows);
    for (uint32_t j = 1; j < program->n_epochs; j++) {
        const srt_matrices *matrices = program->epochs + j;
        int64_t frame = loop->frame - j;
        for (uint32_t w = 0; w < loop->n_sensors; w++)
            if (loop->all_sensors >> w & 1)
                srt_loop_add_product(loop, matrices, w, srt_loop_slopes(loop, frame, w), loop->product, loop->older);
        if (program->polc) {
            multiply_mirror(loop, matrices->Q, loop->mirror[frame % SRT_ROWS], loop->product);
            for (size_t i = 0; i < loop->n_rows; i++)
                loop->older[i] += loop->product[i];
        }
    }
}

/* The gain of the next frame, and what is kept of the state with it: both follow the ramp. */
static float set_gain(srt_loop *loop)
{
    const srt_program *program = loop->program;
    loop->gain = program->gain;
    if (!loop->closed || loop->frames_closed + 1 >= program->ramp)
        return program->keep;
    loop->gain *= (float)(loop->frames_closed + 1) / (float)program->ramp;
    return program->polc ? program->retained * (1.0f - loop->gain) : program->keep;
}

/* c, with what was on the mirror in this exposure. */
static void expect(srt_loop *loop, srt_mirror mirror)
{
    loop->mirror_frame = mirror.newest;
    loop->mirror_frame_before = mirror.before;
    loop->mirror_fraction = mirror.fraction;
    const srt_program *program = loop->program;
    if (!program)
        return;
    size_t m = loop->n_rows;
    float *restrict q = loop->q;
    if (program->polc)
        multiply_mirror(loop, loop->matrices->Q, mirror, q);
    else
        zero(q, m);
    const float *reference = program->alone_reference;
    if (loop->several) {
        for (size_t i = 0; i < m; i++)
            q[i] += loop->older[i];
        reference = program->reference;
    }
    float kept = set_gain(loop), gain = loop->gain, *restrict prepared = loop->prepared;
    const float *state = loop->state;
    for (size_t i = 0; i < m; i++)
        prepared[i] = kept * state[i] + gain * (q[i] - reference[i]);
}

static void expect_in_time(srt_loop *loop)
{
    expect(loop, (srt_mirror){loop->frame - loop->whole, loop->frame - loop->whole - 1, loop->fraction});
}

void srt_loop_prepare(srt_loop *loop)
{
    const srt_program *posted = atomic_exchange(&loop->posted, NULL);
    if (posted) {
        loop->program = posted;
        loop->token = posted->token;
        loop->wanted = posted->sensors & loop->all_sensors;
    }
    int requested = atomic_load(&loop->requested);
    if (requested == SRT_CLOSED && loop->program && !loop->closed)
        loop->frames_closed = 0;
    loop->closed = requested == SRT_CLOSED && loop->program;
    loop->held_flat = requested == SRT_FLAT;
    no_sensor_came(loop);
    form_older(loop);
    expect_in_time(loop);
}

void srt_loop_multiply(srt_loop *loop, uint32_t sensor, uint32_t n)
{
    if (!(loop->wanted >> sensor & 1))
        return;
    const float *slopes = srt_loop_slopes(loop, loop->frame, sensor);
    size_t first = 2 * (size_t)loop->multiplied[sensor], last = 2 * (size_t)n;
    loop->finite = srt_all_finite(slopes + first, last - first) && loop->finite;
    if (loop->program)
        accumulate(loop, loop->matrices, sensor, first, last, slopes, loop->sums + (size_t)sensor * loop->n_rows);
    loop->multiplied[sensor] = n;
    if (n == loop->n_subapertures[sensor])
        loop->sensors |= 1u << sensor;
}

void srt_loop_add(srt_loop *loop, uint32_t sensor, const float *slopes)
{
    uint32_t n = loop->n_subapertures[sensor];
    srt_interleave(slopes, n, srt_loop_slopes(loop, loop->frame, sensor));
    loop->multiplied[sensor] = 0;
    zero(loop->sums + (size_t)sensor * loop->n_rows, loop->n_rows);
    srt_loop_multiply(loop, sensor, n);
}

static void relax(const srt_loop *loop, float *state)
{
    float share = loop->held_flat ? 0.0f : 1.0f - loop->program->relaxation;
    for (size_t i = 0; i < loop->n_rows; i++) {
        float value = state[i] * share;
        state[i] = fabsf(value) < 1e-12f ? 0.0f : value; /* a picometre: do not decay into denormals */
    }
}

/* m = clip(u + o + t); here and below offset is o + t, and u = m - o - t where that changed anything. */
static void clip(srt_loop *loop, const float *offset)
{
    const float *limit = loop->program->limit;
    float *restrict state = loop->state, *restrict command = loop->command;
    uint32_t clipped = 0;
    for (size_t i = 0; i < loop->n_rows; i++) {
        float wanted = state[i] + offset[i];
        float m = wanted > limit[i] ? limit[i] : wanted < -limit[i] ? -limit[i] : wanted;
        bool over = m != wanted;
        state[i] = over ? m - offset[i] : state[i];
        command[i] = m;
        clipped += over;
    }
    loop->n_clipped = clipped;
}

double srt_loop_rms(const srt_loop *loop, const float *commands)
{
    enum { LANES = 8 }; /* n_rows is a multiple: a fixed order of summation on every machine */
    double sums[LANES] = {0}, total = 0;
    for (size_t i = 0; i < loop->n_rows; i += LANES)
        for (int lane = 0; lane < LANES; lane++)
            sums[lane] += (double)commands[i + lane] * commands[i + lane];
    for (int lane = 0; lane < LANES; lane++)
        total += sums[lane];
    return sqrt(total / loop->n_commands);
}

/* The whole command smaller, in the same shape, where its rms is above the limit. */
static void scale(srt_loop *loop, const float *offset)
{
    float limit = loop->program->rms, *restrict command = loop->command;
    loop->scaled = 0;
    if (limit == INFINITY)
        return;
    double rms = srt_loop_rms(loop, command);
    if (rms <= limit * (1 + 1e-6)) /* what was scaled before is not scaled again for its rounding */
        return;
    loop->scaled = 1;
    float share = (float)(limit / rms), *restrict state = loop->state;
    for (size_t i = 0; i < loop->n_rows; i++) {
        command[i] *= share;
        state[i] = command[i] - offset[i];
    }
}

/* No command further from the last than the limit. It has the last word: from one command within all limits to another,
 * the rms may be above its own by as much as this limit. */
static void slew(srt_loop *loop, const float *offset)
{
    float limit = loop->program->slew, *restrict command = loop->command, *restrict state = loop->state;
    loop->n_slewed = 0;
    if (limit == INFINITY || loop->leaps)
        return;
    const float *last = shown(loop, loop->frame - 1);
    uint32_t slewed = 0;
    for (size_t i = 0; i < loop->n_rows; i++) {
        float wanted = command[i], low = last[i] - limit, high = last[i] + limit;
        float m = wanted > high ? high : wanted < low ? low : wanted;
        bool over = m != wanted;
        state[i] = over ? m - offset[i] : state[i];
        command[i] = m;
        slewed += over;
    }
    loop->n_slewed = slewed;
}

static int finish(srt_loop *loop, int verdict)
{
    const srt_program *program = loop->program;
    if (verdict == SRT_OK || verdict == SRT_OPEN || verdict == SRT_HOLD_CLOSED)
        loop->consecutive_holds = 0;
    else
        loop->consecutive_holds++;
    if (program) {
        if (!loop->closed) {
            relax(loop, loop->state);
            relax(loop, loop->tip_tilt.command);
        }
        const float *offset = srt_tip_tilt_answer(loop);
        clip(loop, offset);
        scale(loop, offset);
        slew(loop, offset);
        if (loop->closed && loop->consecutive_holds > program->fault_budget) {
            srt_loop_request(loop, SRT_RELAXES);
            loop->opened_by_faults++;
        }
    }
    if (loop->closed && loop->frames_closed < UINT32_MAX)
        loop->frames_closed++;
    int64_t frame = loop->frame;
    copy(loop->history + (size_t)(frame % SRT_HISTORY) * loop->n_rows, loop->command, loop->n_rows);
    keep(loop, frame, verdict == SRT_OK && loop->wanted == loop->all_sensors,
         (srt_mirror){loop->mirror_frame, loop->mirror_frame_before, loop->mirror_fraction});
    loop->verdict = verdict;
    loop->used = loop->sensors | loop->tip_tilt.used;
    loop->answered = frame;
    loop->frame = frame + 1;
    loop->sensors = 0;
    return verdict;
}

/* Whether a command is in the history, and still will be when this exposure is the oldest that is used. */
static bool known(const srt_loop *loop, int64_t frame)
{
    int64_t oldest = loop->frame - SRT_HISTORY + loop->max_epochs - 1;
    if (oldest < loop->first_frame)
        oldest = loop->first_frame;
    return frame == -1 || (oldest <= frame && frame < loop->frame);
}

int srt_loop_answer(srt_loop *loop, int64_t newest, int64_t before, float fraction)
{
    const srt_program *program = loop->program;
    if (program && program->held)
        return finish(loop, SRT_HOLD_CLOSED); /* an open loop relaxes all the same */
    if (!loop->closed)
        return finish(loop, SRT_OPEN);
    if (!loop->finite)
        return finish(loop, SRT_HOLD_NONFINITE);
    if (program->polc && newest != SRT_MIRROR_UNKNOWN) {
        if (!(known(loop, newest) && (fraction == 1.0f || known(loop, before)) && fraction >= 0.0f &&
              fraction <= 1.0f))
            return finish(loop, SRT_HOLD_HISTORY);
        if (newest != loop->mirror_frame || fraction != loop->mirror_fraction ||
            (fraction != 1.0f && before != loop->mirror_frame_before))
            expect(loop, (srt_mirror){newest, before, fraction});
    }
    size_t m = loop->n_rows;
    float gain = loop->gain, *restrict total = loop->product, *restrict trial = loop->trial;
    const float *prepared = loop->prepared;
    zero(total, m);
    for (uint32_t w = 0; w < loop->n_sensors; w++)
        if (loop->wanted >> w & 1)
            add_scaled(loop, loop->matrices, w, loop->sums + (size_t)w * m, total);
    for (size_t i = 0; i < m; i++)
        trial[i] = prepared[i] + gain * total[i];
    if (!srt_all_finite(trial, m))
        return finish(loop, SRT_HOLD_NONFINITE);
    copy(loop->state, trial, m);
    return finish(loop, SRT_OK);
}

int srt_loop_hold(srt_loop *loop, int verdict)
{
    return finish(loop, verdict);
}

int srt_loop_flatten(srt_loop *loop)
{
    zero(loop->state, loop->n_rows);
    zero(loop->tip_tilt.command, loop->n_rows);
    loop->stars.given = -1;
    loop->sensors = 0;
    loop->leaps = true;
    int verdict = finish(loop, SRT_OPEN);
    loop->leaps = false;
    return verdict;
}
