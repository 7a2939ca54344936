/* One instance of a controller FMU, under FMI 2.0 (fmi2.c) and 3.0 (fmi3.c) alike: its variables, steps, saved states.

   The controller samples on a time grid of its own, start + k period, with the inputs as they stand in the
   communication step that holds the sample; between samples the outputs are held. A sample that the controller refuses
   sets `fault`, holds the MV and leaves the law's state as it was. */

#define _POSIX_C_SOURCE 200809L
#include "law_controller.c" /* plain_controller.c or onnxruntime_controller.c */

#include <float.h>
#include <stdint.h>
#include <stdlib.h>

/* Value references. variables.py counts them in the same way: VR_FIRST on, group after group. */
enum { VR_TIME, VR_FAULT, VR_USE_APPLIED, VR_FIRST };
enum { G_SP, G_PV, G_DV, G_APPLIED, G_START, G_MV, G_INFO, G_OPERATE, G_FRESH, G_USE_FRESH, G_AHEAD, GROUPS };
static const char *const GROUP[GROUPS] = {"sp", "pv", "dv", "mv_applied", "mv_start", "mv", "info", "operate", "fresh",
                                          "use_fresh", "ahead"};

/* The memory of an instance is one block of doubles, so that it is saved and restored at once: these entries, the
   variables, the law's state. */
enum { PHASE, BEGINS, NOW, SAMPLES, FAULT, USE_APPLIED, APPLIED_IS_SET, OWN };
enum { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED };
enum { LOG_WARNING = 1, LOG_ERROR = 3 }; /* fmi2Status and fmi3Status agree on these */

typedef struct Instance Instance;
typedef void Say(const Instance *, int status, const char *category, const char *words);

struct Instance {
  Controller c;
  char *name;
  void *environment;
  Say *say;
  bool logs_warnings;
  double *memory; /* OWN entries, the variables of all groups, the law's state */
  size_t at[GROUPS], n[GROUPS], n_memory;
  char words[2 * WORDS];
};

#define SLACK 1e-6 /* share of a period by which a communication point may miss the grid */

static void speak(Instance *i, int status, const char *format, ...) {
  if (status == LOG_WARNING && !i->logs_warnings) return;
  va_list arguments;
  va_start(arguments, format);
  vsnprintf(i->words, sizeof i->words, format, arguments);
  va_end(arguments);
  i->say(i, status, status == LOG_WARNING ? "logStatusWarning" : "logStatusError", i->words);
}

#define REFUSE(i, ...) (speak(i, LOG_ERROR, __VA_ARGS__), false)

/* ------------------------------------------------------------------ begin and end */
static void instance_reset(Instance *i) {
  memset(i->memory, 0, i->n_memory * sizeof *i->memory);
  i->memory[USE_APPLIED] = 1;
  static const int OF[G_INFO] = {SP, PV, DV, MV, MV, MV};
  for (int g = 0; g < G_INFO; g++)
    for (size_t k = 0; k < i->n[g]; k++) i->memory[i->at[g] + k] = middle(&i->c.signals[OF[g]].at[k]);
  for (size_t k = 0; k < i->n[G_OPERATE]; k++) i->memory[i->at[G_OPERATE] + k] = i->c.operate_entries[k].standard;
  for (size_t k = 0; k < i->n[G_FRESH]; k++) i->memory[i->at[G_FRESH] + k] = 1;
  controller_cold(&i->c);
}

static void instance_free(Instance *i) {
  controller_close(&i->c);
  free(i->memory);
  free(i->name);
  free(i);
}

/* The text that modelDescription.xml names as guid or instantiationToken: the first digits of the file's SHA-256. */
static bool is_token_of(const Controller *c, const char *token) {
  const char *hex = c->digest;
  char wanted[40];
  snprintf(wanted, sizeof wanted, "{%.8s-%.4s-%.4s-%.4s-%.12s}", hex, hex + 8, hex + 12, hex + 16, hex + 20);
  return token && !strcmp(token, wanted);
}

static bool instance_open(Instance *i, const char *token, const char *resources) {
  if (!controller_of(&i->c, resources)) return REFUSE(i, "%s", i->c.words);
  if (!is_token_of(&i->c, token)) return REFUSE(i, "the FMU's token %s is not of its controller", token ? token : "");
  static const int OF[GROUPS] = {SP, PV, DV, MV, [G_OPERATE] = OPERATE, [G_FRESH] = FRESH, [G_USE_FRESH] = FRESH, [G_AHEAD] = AHEAD};
  size_t end = OWN;
  for (int g = 0; g < GROUPS; g++) {
    if (g == G_START || g == G_MV) i->n[g] = i->c.n_in[MV];
    else if (g == G_INFO) i->n[g] = i->c.n_out[OUT_INFO];
    else i->n[g] = !i->c.uses[OF[g]] ? 0 : g == G_USE_FRESH ? 1 : i->c.n_in[OF[g]];
    i->at[g] = end;
    end += i->n[g];
  }
  i->n_memory = end + i->c.n_in[STATE];
  if (!(i->memory = calloc(i->n_memory, sizeof *i->memory))) return REFUSE(i, "no memory");
  instance_reset(i);
  return true;
}

static Instance *instance_new(const char *name, const char *token, const char *resources, void *environment, Say *say,
                              bool logs_warnings) {
  Instance *i = calloc(1, sizeof *i);
  if (!i) return NULL;
  size_t room = strlen(name ? name : "") + 1;
  i->environment = environment;
  i->say = say;
  i->logs_warnings = logs_warnings;
  if ((i->name = malloc(room))) {
    memcpy(i->name, name ? name : "", room);
    if (instance_open(i, token, resources)) return i;
  }
  instance_free(i);
  return NULL;
}

static bool instance_begin(Instance *i, double at) {
  if (i->memory[PHASE] != INSTANTIATED) return REFUSE(i, "an initialization follows an instantiation or a reset only");
  if (!isfinite(at)) return REFUSE(i, "the simulation cannot start at %g s", at);
  i->memory[BEGINS] = i->memory[NOW] = at;
  i->memory[PHASE] = INITIALIZING;
  return true;
}

static bool instance_begun(Instance *i) {
  if (i->memory[PHASE] != INITIALIZING) return REFUSE(i, "no initialization is under way");
  for (size_t k = 0; k < i->n[G_START]; k++) {
    const Signal *s = &i->c.signals[MV].at[k];
    double value = i->memory[i->at[G_START] + k];
    if (!may_be(s, value, 0) || (s->values && !among(s, value)))
      return REFUSE(i, "mv_start.%s = %g %s is not allowed: its range is %g to %g%s", s->name, value, s->unit, s->low,
                    s->high, s->values ? ", and it has set values only" : "");
  }
  if (!operate_allowed(&i->c, i->memory + i->at[G_OPERATE], i->n[G_OPERATE])) return REFUSE(i, "%s", i->c.words);
  i->memory[PHASE] = STEPPING;
  return true;
}

static void instance_end(Instance *i) { i->memory[PHASE] = TERMINATED; }

/* ------------------------------------------------------------------ variables */
/* The group of a value reference, and in *entry its place in the memory; -1 where it is no real variable of a group. */
static int group_of(const Instance *i, unsigned reference, size_t *entry) {
  *entry = OWN + (size_t)reference - VR_FIRST;
  for (int g = 0; reference >= VR_FIRST && g < GROUPS; g++)
    if (*entry < i->at[g] + i->n[g]) return g;
  return -1;
}

static bool get_real(Instance *i, unsigned reference, double *value) {
  size_t entry;
  if (reference == VR_TIME) return *value = i->memory[NOW], true;
  int g = group_of(i, reference, &entry);
  if (g < 0 || g == G_USE_FRESH) return REFUSE(i, "there is no real variable %u", reference);
  *value = i->memory[entry];
  return true;
}

static bool set_real(Instance *i, unsigned reference, double value) {
  size_t entry;
  int g = group_of(i, reference, &entry), phase = (int)i->memory[PHASE];
  if (g < 0 || g == G_USE_FRESH) return REFUSE(i, "there is no real variable %u that could be set", reference);
  bool output = g == G_MV || g == G_INFO;
  if (output || phase == TERMINATED || (g == G_START && phase == STEPPING))
    return REFUSE(i, "variable %u, of %s, cannot be set %s", reference, GROUP[g],
                  output ? "because it is an output" : phase == STEPPING ? "after the initialization" : "after the end");
  if (g == G_OPERATE && !operate_within(&i->c, entry - i->at[g], value)) return REFUSE(i, "%s", i->c.words);
  i->memory[entry] = value;
  /* A tool may write the start values of inputs that nothing is connected to, but it does so before the first step. */
  if (g == G_APPLIED && phase == STEPPING) i->memory[APPLIED_IS_SET] = 1;
  if (g == G_START) i->memory[entry - i->at[G_START] + i->at[G_MV]] = value;
  return true;
}

/* Where a Boolean variable is remembered; 0 where there is none of this value reference. */
static size_t flag_of(const Instance *i, unsigned reference) {
  size_t entry;
  if (reference == VR_FAULT) return FAULT;
  if (reference == VR_USE_APPLIED && i->n[G_APPLIED]) return USE_APPLIED;
  return group_of(i, reference, &entry) == G_USE_FRESH ? entry : 0;
}

static bool get_boolean(Instance *i, unsigned reference, bool *value) {
  size_t entry = flag_of(i, reference);
  if (!entry) return REFUSE(i, "there is no Boolean variable %u", reference);
  *value = i->memory[entry] != 0;
  return true;
}

static bool set_boolean(Instance *i, unsigned reference, bool value) {
  size_t entry = flag_of(i, reference);
  if (!entry || entry == FAULT) return REFUSE(i, "variable %u cannot be set as a Boolean", reference);
  if (i->memory[PHASE] == STEPPING || i->memory[PHASE] == TERMINATED) /* it is a fixed parameter, as mv_start is */
    return REFUSE(i, "%s cannot be set after the %s", entry == USE_APPLIED ? "use_mv_applied" : "use_fresh",
                  i->memory[PHASE] == STEPPING ? "initialization" : "end");
  i->memory[entry] = value;
  return true;
}

/* ------------------------------------------------------------------ steps */
static void sample(Instance *i, double at_s) {
  double *m = i->memory;
  bool connected = i->n[G_APPLIED] && m[USE_APPLIED] != 0 && m[APPLIED_IS_SET] != 0;
  const double *const given[STATE] = {m + i->at[G_SP], m + i->at[G_PV], m + i->at[G_DV],
                                      m + i->at[connected ? G_APPLIED : G_MV]};
  bool told = i->n[G_FRESH] && m[i->at[G_USE_FRESH]] != 0;
  for (size_t k = 0; k < i->n[G_FRESH]; k++) i->c.fresh[k] = told ? m[i->at[G_FRESH] + k] : 1;
  memcpy(i->c.ahead, m + i->at[G_AHEAD], i->n[G_AHEAD] * sizeof *m);
  m[FAULT] = controller_step(&i->c, given) != STEPPED;
  if (m[FAULT] != 0) {
    speak(i, LOG_WARNING, "the sample at %.15g s is refused and the MV held: %s", at_s, i->c.words);
    return;
  }
  memcpy(m + i->at[G_MV], i->c.out[OUT_MV], i->n[G_MV] * sizeof *m);
  memcpy(m + i->at[G_INFO], i->c.out[OUT_INFO], i->n[G_INFO] * sizeof *m);
}

/* From `from` on for `length` seconds: every sample of the grid in [from, from + length) is taken. */
static bool instance_step(Instance *i, double from, double length) {
  double *m = i->memory, period = i->c.period_s, end = from + length;
  double slack = SLACK * period + 8 * DBL_EPSILON * fabs(end);
  if (m[PHASE] != STEPPING) return REFUSE(i, "a step needs an initialization before it");
  if (!(length >= 0) || !isfinite(end) || !((end - m[BEGINS]) / period < 1e15))
    return REFUSE(i, "a communication step of %g s from %g s on is not allowed", length, from);
  if (!(fabs(from - m[NOW]) <= slack))
    return REFUSE(i, "the step begins at %.15g s, but the last one ended at %.15g s", from, m[NOW]);
  /* The ends of a range are set one by one, so that they are compared here. */
  if (i->n[G_OPERATE] && !controller_operate(&i->c, m + i->at[G_OPERATE])) return REFUSE(i, "%s", i->c.words);
  for (double at; (at = m[BEGINS] + m[SAMPLES] * period) < end - slack; m[SAMPLES]++) sample(i, at);
  m[NOW] = end;
  return true;
}

/* ------------------------------------------------------------------ saved states */
typedef struct {
  char digest[64]; /* of the controller file: its states fit no other one */
  uint64_t n;      /* numbers that follow */
  double numbers[];
} Saved;

static size_t saved_size(const Instance *i) { return sizeof(Saved) + i->n_memory * sizeof(double); }

/* Into *to, which is allocated where it is NULL. */
static bool instance_save(Instance *i, Saved **to) {
  if (!*to && !(*to = malloc(saved_size(i)))) return REFUSE(i, "no memory");
  memcpy((*to)->digest, i->c.digest, sizeof (*to)->digest);
  (*to)->n = i->n_memory;
  size_t n_state = i->c.n_in[STATE];
  memcpy(i->memory + i->n_memory - n_state, i->c.state, n_state * sizeof *i->memory);
  memcpy((*to)->numbers, i->memory, i->n_memory * sizeof *i->memory);
  return true;
}

static bool is_ours(Instance *i, const void *bytes, size_t size) {
  Saved head;
  if (!bytes || size != saved_size(i)) return REFUSE(i, "a saved state of %zu bytes is none of this FMU", size);
  memcpy(&head, bytes, sizeof head);
  if (head.n == i->n_memory && !memcmp(head.digest, i->c.digest, sizeof head.digest)) return true;
  return REFUSE(i, "the saved state is of another controller file");
}

static bool finite_all(const double *values, size_t n) {
  for (size_t k = 0; k < n; k++)
    if (!isfinite(values[k])) return false;
  return true;
}

static bool allowed_mv(const Instance *i, const double *values) {
  for (size_t k = 0; k < i->n[G_MV]; k++) {
    const Signal *s = &i->c.signals[MV].at[k];
    if (!may_be(s, values[k], 0) || (s->values && !among(s, values[k]))) return false;
  }
  return true;
}

/* Whether an instance can have remembered these numbers. Inputs may be anything: a sample refuses them by itself. */
static bool plausible(Instance *i, const double *m) {
  double phase = m[PHASE], samples = m[SAMPLES];
  const double *start = m + i->at[G_START], *mv = m + i->at[G_MV];
  bool begun = phase == STEPPING || phase == TERMINATED;
  bool untouched = !memcmp(start, mv, i->n[G_MV] * sizeof *mv); /* no sample yet: set_real keeps both the same */
  if (!begun && phase != INSTANTIATED && phase != INITIALIZING) return REFUSE(i, "the saved state has no phase");
  for (int k = FAULT; k < OWN; k++)
    if (m[k] != 0 && m[k] != 1) return REFUSE(i, "the saved state has a flag of %g", m[k]);
  /* A wrong count of samples would never end. */
  if (!isfinite(m[BEGINS]) || !isfinite(m[NOW]) || !(begun ? samples >= 0 && samples == floor(samples) : samples == 0) ||
      (phase == STEPPING && !(fabs((m[NOW] - m[BEGINS]) / i->c.period_s - samples) <= 2)))
    return REFUSE(i, "the times of the saved state do not agree");
  /* Before the end of the initialization mv_start is as the tool set it, and checked then. */
  if (phase == STEPPING ? !allowed_mv(i, start) || !allowed_mv(i, mv) : !untouched && !(begun && allowed_mv(i, mv)))
    return REFUSE(i, "the saved state has an MV that is not allowed");
  for (size_t k = 0; k < i->n[G_OPERATE]; k++)
    if (!operate_within(&i->c, k, m[i->at[G_OPERATE] + k])) return REFUSE(i, "the saved state has %s", i->c.words);
  if (i->n[G_USE_FRESH] && m[i->at[G_USE_FRESH]] != 0 && m[i->at[G_USE_FRESH]] != 1)
    return REFUSE(i, "the saved state has a flag of %g", m[i->at[G_USE_FRESH]]);
  size_t n_state = i->c.n_in[STATE];
  if (!finite_all(m + i->at[G_INFO], i->n[G_INFO]) || !finite_all(m + i->n_memory - n_state, n_state))
    return REFUSE(i, "the saved state has info or a state of the law that is not finite");
  return true;
}

static bool instance_restore(Instance *i, const Saved *from) {
  if (!from) return REFUSE(i, "no state is given");
  if (!is_ours(i, from, saved_size(i)) || !plausible(i, from->numbers)) return false;
  size_t n_state = i->c.n_in[STATE];
  memcpy(i->memory, from->numbers, i->n_memory * sizeof *i->memory);
  memcpy(i->c.state, i->memory + i->n_memory - n_state, n_state * sizeof *i->memory);
  return true;
}

static bool instance_write(Instance *i, const Saved *from, void *bytes, size_t size) {
  if (!from || size < saved_size(i)) return REFUSE(i, "a state needs %zu bytes, and %zu are given", saved_size(i), size);
  memcpy(bytes, from, saved_size(i));
  return true;
}

/* A state's bytes may come from a file, so its numbers are not believed. They may also lie at any address. */
static bool instance_read(Instance *i, const void *bytes, size_t size, Saved **to) {
  if (!is_ours(i, bytes, size)) return false;
  Saved *copy = malloc(size);
  if (!copy) return REFUSE(i, "no memory");
  memcpy(copy, bytes, size);
  bool good_one = plausible(i, copy->numbers);
  if (good_one && *to) memcpy(*to, copy, size);
  if (good_one && !*to) *to = copy;
  else free(copy);
  return good_one;
}
