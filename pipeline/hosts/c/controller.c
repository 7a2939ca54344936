/* A controller in a host: its signals and ranges, what it may be given, and what may be taken of a step.

   The law itself is not in here. A file that includes this one defines `run_graph`, which computes c->out from c->in, and
   makes and frees a Controller: host.c with onnxruntime, an FMU with the plain C of one controller. */

#include <math.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>

enum { WORDS = 512 };

typedef struct {
  const char *name, *unit; /* in the manifest */
  double low, high;
  const double *values; /* of a discrete signal */
  size_t n_values;
  double max_move; /* of an MV: its largest change a period; INFINITY without a limit */
} Signal;

typedef struct {
  const Signal *at;
  size_t n;
} Signals;

typedef struct {
  const char *name; /* as y0.low; of the whole law speed */
  const char *unit;
  double standard, low, high; /* its default, and the engineered range */
  bool is_switch;             /* 0 or 1 */
  bool of_cv;                 /* of a controlled variable */
  size_t above; /* of a low end: the place of the high one, which it must not exceed; its own place of any other */
} Operate;

enum { SP, PV, DV, MV, STATE, OPERATE, FRESH, AHEAD, INPUTS }; /* the first four have signals */
enum { OUT_MV, OUT_STATE, OUT_INFO, OUTPUTS };
static const char *const INPUT[INPUTS] = {"sp", "pv", "dv", "mv_applied", "state", "operate", "fresh", "ahead"};
static const char *const OUTPUT[OUTPUTS] = {"mv", "state_next", "info"};

typedef struct Graph Graph; /* of whoever includes this file */
typedef enum { STEPPED, REFUSED_INPUT, REFUSED_OUTPUT } Outcome;

typedef struct {
  Graph *graph;    /* the law: what `run_graph` computes */
  char digest[65]; /* of the file, SHA-256 in hexadecimal digits */
  Signals signals[STATE]; /* sp, pv, dv, mv */
  size_t n_in[INPUTS], n_out[OUTPUTS];
  bool uses[INPUTS];
  double period_s;
  const Operate *operate_entries; /* what operators may change, n_in[OPERATE] of them */
  double *operate; /* of all steps; the defaults until controller_operate */
  double *fresh; /* 1 for a new and good reading of each PV, else 0: all 1 unless you write them before a step */
  double *ahead; /* differences to come of set points and measured disturbances: 0 unless you write them before a step */
  const double *ahead_low, *ahead_high; /* of each set point and measured disturbance to come */
  double *state;       /* what the law remembers: the last step's state_next; zeros: no past */
  double *in[INPUTS];  /* the graph reads here */
  double *out[OUTPUTS]; /* and writes here: mv, state_next and info of the last step */
  char words[WORDS]; /* why the last call failed */
} Controller;

static bool failed(Controller *c, const char *format, ...) {
  va_list arguments;
  va_start(arguments, format);
  vsnprintf(c->words, WORDS, format, arguments);
  va_end(arguments);
  return false;
}

static bool run_graph(Controller *c);

/* State zero means: no past. Also right after any gap. */
static void controller_cold(Controller *c) { memset(c->state, 0, c->n_in[STATE] * sizeof *c->state); }

static double middle(const Signal *s) {
  double at = (s->low + s->high) / 2, best = at;
  for (size_t i = 0; i < s->n_values; i++)
    if (!i || fabs(s->values[i] - at) < fabs(best - at)) best = s->values[i];
  return best;
}

static bool among(const Signal *s, double value) {
  for (size_t i = 0; i < s->n_values; i++)
    if (s->values[i] == value) return true;
  return false;
}

/* Whether a signal may have this value; `margin` widens its range by a share on both sides. NaN: false. */
static bool may_be(const Signal *s, double value, double margin) {
  double slack = margin * (s->high - s->low);
  return s->low - slack <= value && value <= s->high + slack;
}

/* Whether an MV may go from `applied` to `value` in a period. The share is what rounding adds to a sum. An applied MV
   outside the range counts as its end. */
#define MOVE_ROUNDING 1e-9
static bool may_move(const Signal *s, double applied, double value) {
  double most = s->max_move + MOVE_ROUNDING * fmax(fabs(s->low), fabs(s->high));
  return fabs(value - fmin(fmax(applied, s->low), s->high)) <= most;
}

/* The place of an entry of operate by its name, as y0.low; n_in[OPERATE] where there is none. */
static size_t operate_place(const Controller *c, const char *name) {
  size_t i = 0;
  while (i < c->n_in[OPERATE] && strcmp(c->operate_entries[i].name, name)) i++;
  return i;
}

/* Whether one value may be given, at place i of operate. NaN: false. */
static bool operate_within(Controller *c, size_t i, double value) {
  const Operate *e = &c->operate_entries[i];
  if (e->low <= value && value <= e->high && (!e->is_switch || value == 0 || value == 1)) return true;
  if (e->is_switch && e->low < e->high) return failed(c, "operate: %.200s is %.6g; allowed is 0 or 1", e->name, value);
  return failed(c, "operate: %.200s is %.6g; allowed is %.6g to %.6g%s%.40s", e->name, value, e->low, e->high,
                *e->unit ? " " : "", e->unit);
}

/* Whether a law may be given these n values, as the manifest's operate lists them. */
static bool operate_allowed(Controller *c, const double *values, size_t n) {
  for (size_t i = 0; i < n; i++)
    if (!operate_within(c, i, values[i])) return false;
  for (size_t i = 0; i < n; i++) {
    const Operate *e = &c->operate_entries[i];
    if (values[i] > values[e->above])
      return failed(c, "operate: %.150s is %.6g, above %.150s = %.6g; a low end must not be above the high one", e->name,
                    values[i], c->operate_entries[e->above].name, values[e->above]);
  }
  return true;
}

/* From the next step on the law has these values (n_in[OPERATE]). False, and nothing changed, where one is not allowed:
   outside its engineered range, a switch neither 0 nor 1, a low end above the high one. */
static bool controller_operate(Controller *c, const double *values) {
  if (!operate_allowed(c, values, c->n_in[OPERATE])) return false;
  memcpy(c->operate, values, c->n_in[OPERATE] * sizeof *values);
  return true;
}

/* Whether c->ahead may be given beside these set points and disturbances: finite, and no value to come out of its range.
   A present value outside it may stay; one that is not finite is refused for itself. */
static bool ahead_allowed(Controller *c, const double *const given[STATE]) {
  size_t n_sp = c->n_in[SP], n = n_sp + c->n_in[DV];
  for (size_t k = 0; c->uses[AHEAD] && k < c->n_in[AHEAD]; k++) {
    bool is_sp = k % n < n_sp;
    const double *values = given[is_sp ? SP : DV];
    double now = values ? values[k % n - (is_sp ? 0 : n_sp)] : NAN, then = now + c->ahead[k];
    double low = c->ahead_low[k % n], high = c->ahead_high[k % n];
    double slack = 1e-9 * (high - low);
    if (isfinite(c->ahead[k]) && (!isfinite(now) || (then >= fmin(low, now) - slack && then <= fmax(high, now) + slack)))
      continue;
    const Signal *s = is_sp ? &c->signals[SP].at[k % n] : &c->signals[DV].at[k % n - n_sp];
    return failed(c, "ahead: %.200s is %.6g at sample %zu; allowed is %.6g to %.6g", s->name, then, k / n + 1, low, high);
  }
  return true;
}

/* One step on given[SP], [PV], [DV], [MV] (the MV that the plant received), c->operate, c->fresh and c->ahead. The state
   stays as it was if refused. A PV that is not fresh must be finite all the same. */
static Outcome controller_step(Controller *c, const double *const given[STATE]) {
  for (size_t k = 0; c->uses[FRESH] && k < c->n_in[FRESH]; k++) {
    if (c->fresh[k] == 0 || c->fresh[k] == 1) continue;
    failed(c, "fresh of %s is %g; it is 1 for a new and good reading, or 0", c->signals[PV].at[k].name, c->fresh[k]);
    return REFUSED_INPUT;
  }
  if (!ahead_allowed(c, given)) return REFUSED_INPUT;
  const double *const own[INPUTS] = {[STATE] = c->state, [OPERATE] = c->operate, [FRESH] = c->fresh, [AHEAD] = c->ahead};
  for (int i = 0; i < INPUTS; i++) {
    const double *values = i < STATE ? given[i] : own[i];
    if (c->uses[i] && c->n_in[i] && !values) {
      failed(c, "%s is missing; no MV is computed without it", INPUT[i]);
      return REFUSED_INPUT;
    }
    for (size_t k = 0; c->uses[i] && k < c->n_in[i]; k++) {
      if (!isfinite(values[k])) {
        failed(c, "%s[%zu] is %g; no MV is computed from it", INPUT[i], k, values[k]);
        return REFUSED_INPUT;
      }
      c->in[i][k] = values[k];
    }
  }
  if (!run_graph(c)) return REFUSED_OUTPUT;
  for (int i = 0; i < OUTPUTS; i++) {
    for (size_t k = 0; k < c->n_out[i]; k++) {
      if (!isfinite(c->out[i][k])) {
        failed(c, "the law gave %s[%zu] = %g, which is not finite", OUTPUT[i], k, c->out[i][k]);
        return REFUSED_OUTPUT;
      }
    }
  }
  for (size_t k = 0; k < c->n_in[MV]; k++) {
    const Signal *s = &c->signals[MV].at[k];
    double value = c->out[OUT_MV][k];
    if (!may_be(s, value, 0) || (s->values && !among(s, value))) {
      failed(c, "the law gave %s = %.17g %s, which it may not have", s->name, value, s->unit);
      return REFUSED_OUTPUT;
    }
    if (s->max_move < INFINITY && !may_move(s, c->in[MV][k], value)) {
      failed(c, "the law gave %s = %.17g %s after %.17g; it may move by at most %g a period", s->name, value, s->unit,
             c->in[MV][k], s->max_move);
      return REFUSED_OUTPUT;
    }
  }
  memcpy(c->state, c->out[OUT_STATE], c->n_in[STATE] * sizeof *c->state);
  return STEPPED;
}
