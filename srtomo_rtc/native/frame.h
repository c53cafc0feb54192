/* The frame path: serialised slopes in, serialised commands out. No allocation once made, no lock, no interpreter.
 *
 * law.c holds the control law, tiptilt.c that of tip-tilt's own loop, crew.c the threads that share their products,
 * lowrank.c some of these, gate.c the frame gate around it, ring.c what both leave for the recorder; ros.c drives them
 * from rcl. What they do is described where Python wraps them: srtomo_rtc/loop.py, crew.py and hrtc.py. Structures that
 * Python reads are mirrored in srtomo_rtc/native.py, which compares srt_abi() with its own sum.
 *
 * Threads: one thread, the loop's, calls everything here but srt_loop_post, srt_loop_request, srt_gate_want_snapshot and
 * the srt_*_next functions, which are for one other thread at a time (or several under the interpreter's lock).
 * Numbers that others may look at are single aligned words with one writer. */
#ifndef SRTOMO_FRAME_H
#define SRTOMO_FRAME_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "crew.h"
#include "lowrank.h"

enum {
    SRT_HISTORY = 64,   /* commands remembered, frames */
    SRT_AHEAD = 8,      /* frames that may be in assembly at once */
    SRT_MAX_EPOCHS = 8, /* exposures that a command may be made from */
    SRT_ROWS = SRT_AHEAD + SRT_MAX_EPOCHS, /* exposures whose slopes are held: those to come and those that were */
    SRT_MAX_SENSORS = 32,
};

/* What became of a message. */
enum srt_put { SRT_PUT, SRT_DUPLICATE, SRT_LATE, SRT_STRAY };

/* msgs_schema/msg/DmCommand's constants */
enum srt_verdict {
    SRT_OK,
    SRT_OPEN,
    SRT_HOLD_NONFINITE,
    SRT_HOLD_INCOMPLETE,
    SRT_HOLD_MISSING,
    SRT_HOLD_BEHIND,
    SRT_HOLD_HISTORY,
    SRT_HOLD_CLOSED,
    SRT_VERDICTS,
};

#define SRT_MIRROR_UNKNOWN INT64_MIN

/* msgs_schema/msg/HrtcEvent's constants */
enum srt_loop_state {
    SRT_RELAXES, /* open: the state decays */
    SRT_CLOSED,
    SRT_FLAT, /* open: no state, the offset alone */
};

/* R and Q for one exposure, in tiles (kernel.h). R: of each sensor, its columns in the order x0 y0 x1 y1 ... of its
 * sub-apertures, so that what has come in order is one run of columns. */
typedef struct {
    const void *R[SRT_MAX_SENSORS];
    const float *R_scales[SRT_MAX_SENSORS]; /* (n_rows) each: R holds 16-bit integers; NULL: float32 */
    const srt_low_rank *low_rank;           /* (n_sensors) instead of R, with scales; NULL: none */
    const uint32_t *rows;                   /* (n_rows) of low_rank: which command's each row is */
    /* of sensors that the program does without, all three are never read */
    const float *Q;
} srt_matrices;

/* Of tip-tilt's own loop. */
typedef struct {
    float gain, keep;
    float weight[SRT_MAX_SENSORS]; /* of a star in the mean over stars that R_t takes; they sum to 1 */
    const float *reference;        /* (n_slopes) y_ref in R's order */
} srt_tip_tilt_law;

/* All that a command is made with. Immutable; vectors have n_rows values (a multiple of the tiles), those beyond the commands zero. */
typedef struct {
    uint64_t token;          /* names it in what the loop tells; not 0 */
    uint64_t reconstructor;  /* id */
    uint32_t settings;       /* id */
    uint32_t fault_budget;
    uint32_t n_epochs;
    uint32_t polc;
    uint32_t sensors;    /* bit w: sensor w is in the sum; others are not waited for, and what they send is ignored */
    uint32_t held;       /* not 0: these sensors only say when to answer; the command is held */
    uint32_t ramp;       /* frames in which the gain rises to its value once the loop is closed; 0: at once */
    float gain, keep, relaxation;
    float retained;      /* 1 - leak: `keep` before POLC's share of the gain is off it */
    float slew, rms;     /* m: most that a command changes in a frame; of the whole command. INFINITY: no limit */
    int64_t watchdog_ns; /* silence of the sensors after which a closed loop opens; 0: none */
    const float *offset, *limit;
    const float *reference, *alone_reference; /* R y_ref: of all epochs, and of the fallback */
    const srt_matrices *epochs;               /* (n_epochs), the newest exposure first */
    const srt_matrices *alone;                /* for the newest exposure alone */
    srt_tip_tilt_law tip_tilt;                /* its R_t is the columns of `alone` */
} srt_program;

/* Tip-tilt's loop of its own, for others to look at. */
typedef struct {
    uint32_t sensors;   /* on stars of its own, which count their own frames; 0: there is no such loop */
    uint32_t used;      /* those whose slopes came into it with the last answer */
    int64_t frame;      /* the newest of their frames in it; -1: none */
    uint64_t frames, partial, held, skipped; /* as in msgs_schema/msg/HrtcStatus */
    float *command;     /* (n_rows) t */
} srt_tip_tilt;

/* The rest of it: tiptilt.c. */
typedef struct {
    int64_t given;      /* frame that the next answer is to use; -1: none */
    int64_t coming;     /* frame that is being put together; -1: none yet */
    int64_t jumped_to;
    uint32_t given_sensors;
    uint32_t arrived, finite, expected; /* of the coming frame: here; here and finite; without which it is waited */
    bool over;                          /* the coming frame was given: what comes of it now comes too late */
    float *given_slopes, *coming_slopes; /* (n_slopes) in R's order */
    float *base, *trial, *product;       /* (n_rows) each; base is offset + t */
} srt_stars;

/* What was on the mirror during an exposure, as in SlopeFrame. */
typedef struct {
    int64_t newest, before;
    float fraction;
} srt_mirror;

typedef struct {
    /* for others to look at */
    int64_t frame, first_frame, answered;
    int64_t mirror_frame, mirror_frame_before;
    uint64_t token; /* of the program that runs; 0: none */
    uint64_t opened_by_faults, opened_by_silence;
    float mirror_fraction;
    float gain;                /* of the next frame; what the last was made with until it is prepared */
    uint32_t sensors, used, all_sensors, wanted; /* wanted: of the program that runs */
    uint32_t consecutive_holds, frames_closed; /* answered since the loop was closed */
    uint32_t n_clipped, n_slewed;
    int32_t scaled;            /* the whole command was made smaller */
    int32_t verdict;
    int32_t closed, held_flat; /* which srt_loop_state, in two */
    atomic_int requested;      /* srt_loop_state */
    uint32_t n_sensors, n_commands, n_rows, n_slopes, max_epochs;
    float *command, *state, *history; /* (n_rows), (n_rows), (SRT_HISTORY, n_rows) */
    srt_tip_tilt tip_tilt;

    /* the loop's own; what stands before is mirrored */
    _Atomic(const srt_program *) posted;
    srt_crew *crew; /* that shares the products; NULL: the loop's thread alone */
    const srt_program *program;
    srt_stars stars;
    const srt_matrices *matrices; /* of the next frame: the newest epoch's, or the fallback's */
    bool several;                 /* earlier exposures are in the next command */
    bool leaps;                   /* the answer heeds no slew limit */
    bool finite;                  /* the next frame's slopes so far are */
    int64_t whole;                /* of the delay, frames */
    float fraction;               /* of an exposure under the command `whole` frames before, when all is in time */
    uint32_t n_subapertures[SRT_MAX_SENSORS];
    uint32_t first_slope[SRT_MAX_SENSORS];
    uint32_t multiplied[SRT_MAX_SENSORS]; /* sub-apertures whose products are in the sums */
    float *slopes;                /* (SRT_ROWS, n_slopes): frame k in row k % SRT_ROWS, in R's order */
    int64_t kept[SRT_ROWS];       /* the frame, if it was answered OK with all sensors */
    srt_mirror mirror[SRT_ROWS];
    float *sums;                  /* (n_sensors, n_rows): R_w y_w so far */
    float *flat, *on_mirror, *q, *product, *older, *prepared, *trial; /* (n_rows) each */
} srt_loop;

/* NULL: no memory, or n_sensors above SRT_MAX_SENSORS. tip_tilt_sensors: bit w set: w is in tip-tilt's own loop. */
srt_loop *srt_loop_new(const uint32_t *n_subapertures, uint32_t n_sensors, uint32_t n_commands, float delay,
                       uint32_t max_epochs, uint32_t tip_tilt_sensors);
void srt_loop_free(srt_loop *loop);
/* Share products with a crew, or NULL: with none. While the loop's thread does not run. */
void srt_loop_use(srt_loop *loop, srt_crew *crew);
void srt_loop_start(srt_loop *loop, int64_t frame, int state);
/* Before srt_loop_resume: an earlier exposure that was answered OK. slopes: (n_slopes) sensor by sensor, x then y. */
void srt_loop_remember(srt_loop *loop, int64_t frame, const float *slopes, int64_t newest, int64_t before,
                       float fraction);
void srt_loop_forget(srt_loop *loop);
void srt_loop_prepare(srt_loop *loop);
/* One sensor's slopes of the next frame, x then y. */
void srt_loop_add(srt_loop *loop, uint32_t sensor, const float *slopes);
/* The sensor's first n sub-apertures of the next frame stand in srt_loop_slopes: form their products. */
void srt_loop_multiply(srt_loop *loop, uint32_t sensor, uint32_t n);
int srt_loop_answer(srt_loop *loop, int64_t newest, int64_t before, float fraction);
int srt_loop_hold(srt_loop *loop, int verdict);
/* The next frame's answer is the offset, at once and whatever came of its slopes: past the slew limit, since no command
 * may follow. */
int srt_loop_flatten(srt_loop *loop);
/* The token of a program that was posted and is now never taken up, or 0. */
uint64_t srt_loop_post(srt_loop *loop, const srt_program *program);
void srt_loop_request(srt_loop *loop, int state);
int srt_loop_pending(srt_loop *loop);

static inline int srt_loop_state_of(const srt_loop *loop)
{
    return loop->closed ? SRT_CLOSED : loop->held_flat ? SRT_FLAT : SRT_RELAXES;
}

/* Of all commands of a frame (n_rows). */
double srt_loop_rms(const srt_loop *loop, const float *commands);

/* total += R_w y for a whole sensor's slopes (in R's order); product: (n_rows) to compute in. */
void srt_loop_add_product(const srt_loop *loop, const srt_matrices *matrices, uint32_t sensor, const float *slopes,
                          float *product, float *total);

/* Where a sensor's slopes of a frame stand, in R's order. */
static inline float *srt_loop_slopes(const srt_loop *loop, int64_t frame, uint32_t sensor)
{
    return loop->slopes + (size_t)(frame % SRT_ROWS) * loop->n_slopes + loop->first_slope[sensor];
}

/* Zeros, aligned as the products want them; NULL: no memory. */
float *srt_floats(size_t n);

/* x0 x1 .. y0 y1 .. (anywhere in memory) to x0 y0 x1 y1 .. */
void srt_interleave(const void *xy, size_t n, float *out);

/* -- tiptilt.c ---------------------------------------------------------------------------------------------------- */

bool srt_tip_tilt_new(srt_loop *loop, uint32_t sensors);
void srt_tip_tilt_free(srt_loop *loop);
void srt_tip_tilt_start(srt_loop *loop);
/* Whole adjacent sensors of a frame of the stars' own count, sensor by sensor, x then y, anywhere in memory. */
enum srt_put srt_tip_tilt_put(srt_loop *loop, int64_t frame, uint32_t first, uint32_t n, const void *slopes);
/* Have the next answer use a frame. slopes: (n_slopes) sensor by sensor, x then y; those of `sensors` count. */
void srt_tip_tilt_give(srt_loop *loop, int64_t frame, uint32_t sensors, const float *slopes);
/* In every answer, once the program is known: take the given frame in. What is on the mirror beside the state,
 * (n_rows): offset + t. */
const float *srt_tip_tilt_answer(srt_loop *loop);

/* -- ring.c ------------------------------------------------------------------------------------------------------- */

/* A ring in shared memory, made, locked and described in srtomo_core/ring.py. */
typedef struct {
    uint8_t *memory;           /* the whole file; NULL: there is none, and nothing is written */
    uint64_t capacity;         /* of the data, bytes */
    int64_t ahead;             /* what the records' times are more than the monotonic clock, ns */
    uint64_t position, number; /* of the next record */
} srt_ring;

enum srt_channel { SRT_SLOPES, SRT_COMMANDS };

/* A message larger than half the ring is left out, and counted by readers as lost. */
void srt_ring_write(srt_ring *ring, uint32_t channel, int64_t now_ns, const uint8_t *message, size_t size);

/* -- gate.c ------------------------------------------------------------------------------------------------------- */

/* Names as in msgs_schema/msg/HrtcStatus. */
typedef struct {
    uint64_t commands;
    uint64_t held_nonfinite, held_incomplete, held_missing, held_behind, held_history, held_closed;
    uint64_t dropped_duplicate, dropped_late, dropped_session, dropped_fingerprint, dropped_malformed;
    uint64_t clipped, slewed, scaled;
    uint64_t fallback;     /* answered from one exposure, of a program of several */
    uint64_t changes_lost; /* nobody took them in time */
} srt_counters;

enum { SRT_BINS_PER_OCTAVE = 16, SRT_OCTAVES = 24, SRT_BINS = SRT_BINS_PER_OCTAVE * SRT_OCTAVES };

/* Bins of 1/16 octave from 1 us; the first holds everything below too. */
typedef struct {
    int64_t deadline_ns, misses, max_ns;
    double sum, squares; /* of all, ns and ns^2 */
    int64_t counts[SRT_BINS];
} srt_latency;

void srt_latency_add(srt_latency *latency, int64_t ns);

enum srt_what { SRT_SESSION, SRT_PROGRAM, SRT_LOOP };
enum srt_reason { SRT_ASKED, SRT_FAULTS, SRT_NEW_SESSION, SRT_GOES_ON, SRT_SILENCE };

/* Something that the loop took up. */
typedef struct {
    uint64_t session, token;
    int64_t frame;
    int64_t number; /* for the reason: frames held in a row, the frame that was due, or ns without slopes */
    int32_t what, reason, state;
} srt_change;

/* The loop after a frame: msgs_schema/msg/HrtcState. */
typedef struct {
    uint64_t session, token;
    int64_t frame, first_frame;
    int32_t stamp_sec;
    uint32_t stamp_nanosec;
    uint32_t consecutive_holds, frames_closed;
    int32_t loop_state;
    float *state, *history; /* (n_rows), (SRT_HISTORY, n_rows) in the loop's order */
    int64_t tip_tilt_frame;
    float *tip_tilt;        /* (n_rows) */
} srt_snapshot;

/* Not 0: the message did not go out. */
typedef int (*srt_publish)(void *context, const uint8_t *message, size_t size);

typedef struct {
    srt_loop *loop;
    uint64_t session;
    int64_t last_slopes_ns, last_tip_tilt_ns;
    srt_counters counters;
    srt_latency latency;       /* last slopes received to command published */
    srt_latency frame_latency; /* first slopes received to command published */
    size_t largest_message; /* a SlopeFrame with every sensor, bytes; its frame_id takes at most 256 */
    srt_publish publish;
    void *publish_context;
    srt_ring ring;    /* every message that is offered, and every command that went out; set before the loop starts */
    int32_t failure;  /* the first nonzero that publish returned since this was set to 0 */
    atomic_int stop;  /* for srt_run */
} srt_gate;

srt_gate *srt_gate_new(const uint32_t *n_subapertures, uint32_t n_sensors, uint32_t n_commands, float delay,
                       uint32_t max_epochs, uint32_t tip_tilt_sensors, const uint8_t fingerprint[32],
                       int64_t deadline_ns, int64_t max_behind);
void srt_gate_free(srt_gate *gate);
void srt_gate_start(srt_gate *gate);
/* The frame of a message that fits the instrument, used or not; -1: it does not, or is of stars that count their own.
 * now_ns: when it was received. The message stays as it is until the next call of this or of srt_gate_advance has returned. */
int64_t srt_gate_offer(srt_gate *gate, const uint8_t *message, size_t size, int64_t now_ns);
void srt_gate_advance(srt_gate *gate);
void srt_gate_idle(srt_gate *gate, int64_t now_ns);
/* Whether anything is on the mirror that a stopping loop has to take off. */
int srt_gate_not_flat(const srt_gate *gate);
void srt_gate_flatten(srt_gate *gate);
/* False: none waits. */
int srt_gate_next_change(srt_gate *gate, srt_change *out);
void srt_gate_want_snapshot(srt_gate *gate);
/* NULL: none waits. It stays as it is until srt_gate_snapshot_done. */
const srt_snapshot *srt_gate_next_snapshot(srt_gate *gate);
void srt_gate_snapshot_done(srt_gate *gate);

int64_t srt_now(void); /* monotonic, ns */
/* By the monotonic clock, when a message was received that the middleware stamped by the system's clock (0: not) and
 * that was not there yet at `looked`: a step of the system's clock cannot be taken for more than the time since. */
int64_t srt_received(int64_t stamp_ns, int64_t looked_ns);

/* Sum of the mirrored structures' sizes; of srt_loop up to `posted`. */
size_t srt_abi(void);

#endif
